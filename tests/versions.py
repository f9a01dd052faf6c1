"""Runs the readers' tests with the oldest and newest NumPy, SciPy and OpenCV that pyproject.toml
allows: `python -m tests.versions`. Both are installed in folders of their own."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
PACKAGES = ("numpy", "opencv-python-headless", "scipy")
TESTS = (
    "tests/session/test_calibration_files.py",
    "tests/session/test_camera_file.py",
    "tests/session/test_cloud_files.py",
    "tests/session/test_matlab_calibration.py",
    "tests/session/test_ply.py",
    "tests/session/test_polygons.py",
    "tests/session/test_reported_files.py",
    "tests/session/test_shape_files.py",
    "tests/proofs/test_prove_files.py",
    "tests/fringe/test_rounded_periods.py",
    "tests/target/test_charuco.py",
)
_SHOWN = "import cv2, numpy, scipy; print(numpy.__version__, scipy.__version__, cv2.__version__)"


def list_sets() -> dict[str, list[str]]:
    """Return the arguments of pip for each set; the newest with numba, which bounds NumPy."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lowest = dict(re.findall(r"^([\w-]+)>=([\w.]+)", "\n".join(project["dependencies"]), re.M))
    oldest = [f"{name}=={lowest[name]}" for name in PACKAGES]
    return {"oldest": ["--no-deps", *oldest], "newest": ["--upgrade", "numba", *PACKAGES]}


def run_tests(folder: str, arguments: list[str]) -> int:
    """Install packages in a folder, and return the status of the tests with them."""
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--target", folder, *arguments]
    subprocess.run(install, check=True)
    paths = [folder, str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    subprocess.run([sys.executable, "-c", _SHOWN], env=environment, cwd=ROOT, check=True)
    test = [sys.executable, "-m", "pytest", "-n", "0", "-q", *TESTS]
    return subprocess.run(test, env=environment, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    statuses = {}
    for name, arguments in list_sets().items():
        with TemporaryDirectory() as folder:
            statuses[name] = run_tests(folder, arguments)
    print(
        ", ".join(
            f"{name}: {'failed' if status else 'passed'}" for name, status in statuses.items()
        )
    )
    sys.exit(any(statuses.values()))

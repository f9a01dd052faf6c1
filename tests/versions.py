"""Runs the readers' tests with the oldest and newest NumPy, SciPy, OpenCV and other packages of the
readers that pyproject.toml allows: `python -m tests.versions`. Both are installed in folders of
their own."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "numpy", "opencv-python-headless", "scipy", "msgspec", "pillow", "pyyaml", "trimesh", "laspy",
    "lazrs", "lxml", "networkx", "pye57", "rawpy",
)  # fmt: skip
TESTS = (
    ("tests/session", "tests/fringe/test_rounded_periods.py", "tests/target/test_charuco.py",
     "tests/pipeline/test_import_captures.py", "tests/pipeline/test_import_cloud.py"),
    ("tests/proofs/test_prove_files.py", "-m", ""),  # with the slow ones, of calibrations
)  # fmt: skip
_SHOWN = f"""from importlib.metadata import version
print(*(name + " " + version(name) for name in {PACKAGES}), sep=", ")"""


def list_sets() -> dict[str, list[str]]:
    """Return the arguments of pip for each set; the newest with numba, which bounds NumPy."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    listed = [*project["dependencies"], *project["optional-dependencies"]["test"]]
    lowest = dict(re.findall(r"^([\w-]+)>=([\w.]+)", "\n".join(listed), re.M))
    oldest = [f"{name}=={lowest[name]}" for name in PACKAGES]
    return {"oldest": ["--no-deps", *oldest], "newest": ["--upgrade", "numba", *PACKAGES]}


def run_tests(folder: str, arguments: list[str]) -> int:
    """Install packages in a folder, and return the status of the tests with them."""
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--target", folder, *arguments]
    subprocess.run(install, check=True)
    paths = [folder, str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    subprocess.run([sys.executable, "-c", _SHOWN], env=environment, cwd=ROOT, check=True)
    test = [sys.executable, "-m", "pytest", "-n", "0", "-q"]
    runs = [
        subprocess.run([*test, *chosen], env=environment, cwd=ROOT, check=False) for chosen in TESTS
    ]
    return max(run.returncode for run in runs)


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

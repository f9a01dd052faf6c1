"""Files and captures of reported situations, made by scripts beside the real captures."""

import subprocess
import sys
from pathlib import Path

import pytest


def make_case(real_data: Path, name: str, folder: Path, *arguments: str) -> Path:
    """Return ``folder``, filled by the script of a reported situation; skips where it is absent."""
    script = real_data / "reports4" / name / "make.py"
    if not script.is_file():
        pytest.skip(f"{script} is missing")
    subprocess.run([sys.executable, script, folder, *arguments], check=True)
    return folder

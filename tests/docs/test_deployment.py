"""What the files for deployment run works here; neither Docker nor systemd is started. .ci/run
lints the Dockerfile."""

import configparser
import json
import os
import re
import shlex
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
import yaml

from slviewer.session.store import Session

DEPLOYMENT = Path(__file__).parents[2] / "docs" / "deployment"
HANG_S = 600.0
"""Nothing takes as long, on any machine."""
DOCKERFILE = (DEPLOYMENT / "Dockerfile").read_text()


def test_the_container_is_not_root_and_holds_nothing_that_is_not_needed() -> None:
    stages = re.split(r"^FROM ", DOCKERFILE, flags=re.MULTILINE)[1:]
    assert len(stages) == 2 and "USER 10001" in stages[1] and "git" not in stages[1]
    ignored = (DEPLOYMENT / "Dockerfile.dockerignore").read_text().split()
    assert {".venv", "**/__pycache__"} & set(ignored)


def test_compose_starts_the_same_command_as_the_image() -> None:
    service = yaml.safe_load((DEPLOYMENT / "compose.yaml").read_text())["services"]["slviewer"]
    assert service["command"] == json.loads(re.findall(r"^CMD (.+)$", DOCKERFILE, re.MULTILINE)[-1])
    assert (
        service["read_only"]
        and service["cap_drop"] == ["ALL"]
        and service["volumes"] == ["data:/data"]
    )
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])


def test_the_unit_starts_a_known_command_as_another_user() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(DEPLOYMENT / "slviewer.service")
    service = unit["Service"]
    assert service["User"] == "slviewer" and service["NoNewPrivileges"] == "yes"
    program, command, *_ = shlex.split(service["ExecStart"])
    assert program == "/opt/slviewer/bin/slviewer" and command == "wizard"


@pytest.mark.slow
@pytest.mark.process
def test_the_image_s_command_serves_and_its_health_check_passes(tmp_path: Path) -> None:
    Session.create(tmp_path / "session").close()
    command = json.loads(re.findall(r"^CMD (.+)$", DOCKERFILE, re.MULTILINE)[-1])
    health = json.loads(re.search(r"CMD (\[\"python\".+\])", DOCKERFILE)[1])  # type: ignore[index]
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = str(probe.getsockname()[1])
    words = [
        word.replace("/data", str(tmp_path)).replace("0.0.0.0", "127.0.0.1") for word in command[1:]
    ]
    server = subprocess.Popen(
        [sys.executable, "-m", "slviewer.cli", *words, "--port", port],
        env=os.environ | {"HOME": str(tmp_path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        end = time.monotonic() + HANG_S
        while True:
            try:
                with urllib.request.urlopen(
                    f"http://127.0.0.1:{port}/healthz", timeout=HANG_S
                ) as answer:
                    assert answer.status == 204
                break
            except OSError:  # it does not listen yet
                assert time.monotonic() < end and server.poll() is None
                time.sleep(0.2)
        check = [
            sys.executable,
            "-c",
            health[2].replace(":8080", f":{port}").replace("timeout=4", f"timeout={HANG_S}"),
        ]
        assert subprocess.run(check, check=False).returncode == 0
        assert (tmp_path / "tokens.toml").stat().st_mode & 0o077 == 0
    finally:
        server.terminate()
        server.wait(timeout=HANG_S)
    assert subprocess.run(check, check=False, stderr=subprocess.DEVNULL).returncode != 0

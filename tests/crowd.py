"""Strangers at the wizard's port: `python -m tests.crowd --connections 2000 --seconds 60`.

So many connections without a token are opened to a wizard in a process of its own, and opened again
when the server ends them, while the operator's link is followed. Prints the operator's waiting
times, and the server's memory, open files, threads and lines of log; ends with status 1 where the
operator was kept out or the server's use is not bounded.
"""

import argparse
import http.client
import json
import re
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

SAID = (
    b"",
    b"GET / HTTP/1.1\r\n",
    b"\x16\x03\x01",
    b"GET /x HTTP/1.1\r\nHost: a\r\n\r\n",
    b"junk\r\n\r\n",
)
PATIENCE_S, AGAIN_S, THREADS = 300.0, 1.0, 8
MAX_LINES, MAX_GROWTH_MB, MAX_FILES = 100, 50.0, 1000


class Server:
    """A wizard in a process of its own, on a small simulated rig."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "log"
        command = [
            sys.executable,
            "-u",
            "-m",
            "slviewer.cli",
            "wizard",
            str(folder / "S"),
            "--rig",
            "simulated:0.1",
        ]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*command, "--no-browser", "--port", "0"], stdout=log, stderr=log
            )
        end = time.monotonic() + PATIENCE_S
        while not (link := re.search(r"http://127\.0\.0\.1:(\d+)/#(\S+)", self.log.read_text())):
            if time.monotonic() > end or self.process.poll() is not None:
                raise SystemExit(f"the wizard did not start: {self.log.read_text()}")
            time.sleep(0.2)
        self.port, self.token = int(link[1]), link[2]

    def measure(self) -> tuple[float, int, int, int]:
        """Return its memory in MB, open files, threads, and lines of log."""
        folder = Path("/proc", str(self.process.pid))
        memory, threads = (
            int(re.search(rf"{name}:\s+(\d+)", (folder / "status").read_text())[1])  # type: ignore[index]
            for name in ("VmRSS", "Threads")
        )
        return (
            memory / 1000,
            len([*(folder / "fd").iterdir()]),
            threads,
            len(self.log.read_text().splitlines()),
        )

    def follow_link(self) -> float:
        """Follow the operator's link to the page, and return the seconds that it took. Raises
        OSError."""
        began = time.monotonic()
        login = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        login.request("GET", "/login", headers={"Authorization": f"Bearer {self.token}"})
        answer = login.getresponse()
        path, cookie = json.loads(answer.read())["path"], answer.headers["Set-Cookie"].split(";")[0]
        page = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        page.request("GET", path, headers={"Cookie": cookie})
        if (status := page.getresponse().status) != 200:
            raise OSError(f"the page was answered with {status}")
        return time.monotonic() - began


class Crowd:
    """Keeps connections open to a port, each opened anew a second after the server ended it."""

    def __init__(self, port: int, count: int) -> None:
        self.made = 0
        self._port, self._over = port, threading.Event()
        self._open: list[list[socket.socket]] = [[] for _ in range(THREADS)]
        self._threads = [
            threading.Thread(target=self._hold, args=(mine, count // THREADS), daemon=True)
            for mine in self._open
        ]
        for thread in self._threads:
            thread.start()

    def _hold(self, mine: list[socket.socket], count: int) -> None:
        """Keep ``count`` connections open until it is over."""
        while not self._over.wait(AGAIN_S):
            mine[:] = [connection for connection in mine if _is_open(connection)]
            for number in range(count - len(mine)):
                if self._over.is_set():
                    return
                try:
                    connection = socket.create_connection(("127.0.0.1", self._port), timeout=5)
                    mine.append(connection)
                    self.made += 1
                    connection.sendall(SAID[number % len(SAID)])
                except OSError:
                    continue

    def count(self) -> int:
        """Return the number of connections that are open at this end."""
        return sum(map(len, self._open))

    def end(self) -> None:
        """Close all."""
        self._over.set()
        for thread, mine in zip(self._threads, self._open, strict=True):
            thread.join()
            for connection in mine:
                connection.close()


def _is_open(connection: socket.socket) -> bool:
    """Whether the server has not ended a connection; closes it otherwise."""
    connection.setblocking(False)
    try:
        if connection.recv(4096):
            return True
    except BlockingIOError:
        return True
    except OSError:
        pass
    connection.close()
    return False


def main() -> int:
    """Run the crowd, and print what came of it."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--connections", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, options.connections + 500), hard))
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder))
        try:
            alone, before = max(server.follow_link() for _ in range(3)), server.measure()
            crowd = Crowd(server.port, options.connections)
            waited, used, held = [], [before], []
            end = time.monotonic() + options.seconds
            try:
                while time.monotonic() < end:
                    time.sleep(2.0)
                    waited.append(server.follow_link())
                    used.append(server.measure())
                    held.append(crowd.count())
            except OSError as error:
                print(f"the operator was kept out: {error}")
                return 1
            finally:
                crowd.end()
        finally:
            server.process.terminate()
            server.process.wait(60)
    growth, files, threads, lines = (
        max(each[k] for each in used) - (0, before[k])[k in (0, 3)] for k in range(4)
    )
    print(
        f"{crowd.made} unauthenticated connections, at most {max(held)} open at once, in"
        f" {options.seconds:g} s: the operator's page came in {max(waited):.2f} s at most"
        f" ({alone:.2f} s without them), {len(waited)} of {len(waited)} times; the server's memory"
        f" {growth:+.1f} MB, {files} files, {threads} threads at most, {lines} lines of log"
    )
    return int(growth > MAX_GROWTH_MB or files > MAX_FILES or lines > MAX_LINES)


if __name__ == "__main__":
    sys.exit(main())

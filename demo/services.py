"""The two processes of the demo: the nightfix daemon and the independent subscriber. Both end with the demo."""

import json
import queue
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path


class DemoError(Exception):
    """Something the demo cannot go on from."""


def free_port() -> int:
    """A TCP port of the loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def stop(process: subprocess.Popen, name: str, timeout_s: float = 15.0) -> int:
    """Asks a process to end (SIGTERM) and returns its exit status."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise DemoError(f"{name} did not stop within {timeout_s:.0f} s of SIGTERM") from None


class Daemon:
    """`nightfix run`, logging to a file."""

    def __init__(self, binary: Path, config: Path, log: Path):
        self.log_path = log
        with open(log, "wb") as file:
            self.process = subprocess.Popen(
                [binary, "run", "--config", config], stdin=subprocess.DEVNULL, stdout=file, stderr=file
            )

    def require_running(self) -> None:
        """Fails, with the end of the log, if the daemon has ended."""
        if (status := self.process.poll()) is not None:
            tail = "".join(self.log_path.read_text(errors="replace").splitlines(keepends=True)[-15:])
            raise DemoError(f"nightfix run ended with status {status}; the end of {self.log_path}:\n{tail}")

    def stop(self) -> int:
        """SIGTERM; its exit status."""
        return stop(self.process, "nightfix run")


class Subscriber:
    """`demo/subscriber.py` in a process of its own; its lines come in through a pipe."""

    def __init__(self, endpoint: str, vehicle: str):
        script = Path(__file__).with_name("subscriber.py")
        self.process = subprocess.Popen(
            [sys.executable, script, "--connect", endpoint, "--vehicle", vehicle],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
        )
        self._lines: queue.Queue = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self._lines.put(json.loads(line))

    def next(self, timeout_s: float) -> dict | None:
        """The next message, or None if none came in time."""
        try:
            return self._lines.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def stop(self) -> int:
        """SIGTERM; its exit status."""
        return stop(self.process, "the subscriber")

"""An emulator in its own process, and its control line, for the tests in this folder."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


class Emulated:
    """A running emulator: its ready line, its process, its control line."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "stimrig.hardware_sim", *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.process.communicate()[1]
        self.ready: dict[str, Any] = json.loads(line)
        self._control = socket.socket(socket.AF_UNIX)
        self._control.connect(self.ready["control"])
        self._lines = self._control.makefile("rb")

    def ask(self, **request: Any) -> dict[str, Any]:
        self._control.sendall(json.dumps(request).encode() + b"\n")
        return json.loads(self._lines.readline())

    def close(self) -> int:
        self._lines.close()
        self._control.close()
        self.process.terminate()
        code = self.process.wait(30)
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        return code


@contextlib.contextmanager
def emulated(*arguments: str) -> Iterator[Emulated]:
    running = Emulated(*arguments)
    try:
        yield running
    finally:
        running.close()


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.005)

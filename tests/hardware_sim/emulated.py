"""An emulator in its own process, and its control line, for the tests in this folder."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.harness.processes import Process, control


class Emulated(Process):
    """A running emulator: its ready line, its process, its control line."""

    def ask(self, **request: Any) -> dict[str, Any]:
        return control(self.ready["control"], request)


@contextlib.contextmanager
def emulated(*arguments: str) -> Iterator[Emulated]:
    with tempfile.TemporaryDirectory(prefix="emulated-") as folder:
        running = Emulated("stimrig.hardware_sim", *arguments, log=Path(folder) / "log")
        try:
            yield running
        finally:
            running.stop()


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.005)

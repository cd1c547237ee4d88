"""The rig on a host that can be made to fail: `python -m tests.harness.campaign.host` takes the rig's arguments.

SIGUSR1 makes the disk slow, then well again; by turns each write to a journal takes 0.4 s, or bringing it to the disk
takes 5 s. SIGUSR2 moves the wall clock on by an hour. The rig itself knows of none of it.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
import time
from typing import Any

from rig.__main__ import main

_write, _fdatasync, _time = os.write, os.fdatasync, time.time
_state: dict[str, Any] = {"slow": "", "ahead_s": 0.0}
_ways = itertools.cycle(("write", "sync"))


def _slow_write(fd: int, data: Any) -> int:
    if _state["slow"] == "write" and len(data) > 24 and bytes(data[:4]) == b"\xa5BLK":
        time.sleep(0.4)
    return _write(fd, data)


def _slow_sync(fd: int) -> None:
    for _ in range(100):
        if _state["slow"] != "sync":
            break
        time.sleep(0.05)
    _fdatasync(fd)


def _toggle(_number: int, _frame: object) -> None:
    _state["slow"] = "" if _state["slow"] else next(_ways)


def _later(_number: int, _frame: object) -> None:
    _state["ahead_s"] += 3600.0


def break_host() -> None:
    """Put the breakable functions in place."""
    os.write, os.fdatasync = _slow_write, _slow_sync
    time.time = lambda: _time() + _state["ahead_s"]
    signal.signal(signal.SIGUSR1, _toggle)
    signal.signal(signal.SIGUSR2, _later)


if __name__ == "__main__":
    break_host()
    sys.exit(main())

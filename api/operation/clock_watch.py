"""Whether this machine's clock is set by a time service, and whether it jumped. UTC is a label: no decision reads this.

The kernel says it where it may be asked; a unit that may not touch the clock (ProtectClock) asks systemd-timedated.
"""

from __future__ import annotations

import ctypes
import logging
import shutil
import struct
import subprocess
from collections.abc import Callable
from dataclasses import dataclass

from stimrig.api.clock import Clock

log = logging.getLogger("stimrig.clock")
JUMP_S = 2.0
LOOK_S, ASK_S = 5.0, 60.0
"""How often it is looked whether the clock jumped, and how often it is asked who sets it."""
UNSYNCHRONISED = 0x40
"""STA_UNSYNC of adjtimex(2)."""
LAYOUT = "@Illlli"
"""The head of `struct timex`: modes, offset, freq, maxerror, esterror, status."""


@dataclass(frozen=True)
class Synchronised:
    """Who sets the clock; `by_service` None: not known. `error_s`: the kernel's bound; None: not known."""

    by_service: bool | None = None
    error_s: float | None = None


def ask_machine() -> Synchronised:
    """Ask the kernel, else systemd-timedated."""
    return ask_kernel() or ask_timedated()


def ask_kernel() -> Synchronised | None:
    """What adjtimex(2) says, which changes nothing; None where this process may not ask."""
    buffer = ctypes.create_string_buffer(512)
    try:
        answer = ctypes.CDLL(None, use_errno=True).adjtimex(buffer)
    except (OSError, AttributeError):
        return None
    if answer < 0:
        return None
    _modes, _offset, _freq, most_us, _est, status = struct.unpack_from(LAYOUT, buffer.raw)
    by_service = not status & UNSYNCHRONISED
    return Synchronised(by_service, most_us * 1e-6 if by_service else None)


def ask_timedated() -> Synchronised:
    """What `timedatectl` says."""
    tool = shutil.which("timedatectl")
    if tool is None:
        return Synchronised()
    command = [tool, "show", "--property=NTPSynchronized", "--value"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return Synchronised()
    return Synchronised({"yes": True, "no": False}.get(answer))


class ClockWatch:
    """Looks again and again; `ask`: who says whether a time service sets the clock."""

    def __init__(self, clock: Clock, ask: Callable[[], Synchronised] = ask_machine) -> None:
        self._clock, self._ask = clock, ask
        self.synchronised = Synchronised()
        self.jumps, self.last_jump_s, self.last_jump_utc = 0, 0.0, ""
        self._apart_s = clock.unix_s() - clock.monotonic_s()
        self._asked_s: float | None = None

    def look(self) -> None:
        """Has UTC moved against the monotonic clock? A jump is logged once."""
        now_s = self._clock.monotonic_s()
        apart_s = self._clock.unix_s() - now_s
        moved_s = apart_s - self._apart_s
        if not (abs(moved_s) <= JUMP_S):
            self.jumps, self.last_jump_s, self.last_jump_utc = self.jumps + 1, moved_s, self._clock.utc()
            log.warning("the machine's clock jumped by %+.1f s; recordings and entries carry its date", moved_s)
        self._apart_s = apart_s
        if self._asked_s is None or now_s - self._asked_s >= ASK_S:
            self.synchronised, self._asked_s = self._ask(), now_s

    def as_dict(self) -> dict[str, bool | int | float | str | None]:
        """As `/health` tells it."""
        return {
            "synchronised": self.synchronised.by_service, "jumps": self.jumps,
            "last_jump_s": round(self.last_jump_s, 3) if self.jumps else None,
            "last_jump_utc": self.last_jump_utc or None,
        }  # fmt: skip

"""Any key in the terminal stops stimulation, at any time, if a person started the rig in a terminal.

Nothing is read if the rig has no terminal of its own (a service, a child of `stimrig serve`), or runs in the
background, where reading would suspend the whole process.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable
from typing import Any


def in_front(fd: int) -> bool:
    """Whether `fd` is a terminal and this process is in its foreground."""
    try:
        return os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:
        return False


class StopKey:
    """While entered, `on_key` is called from the event loop for each key, without waiting for Enter.

    Parameters
    ----------
    loop
        The running event loop.
    fd
        The terminal.
    ours
        Whether its keys are meant for this process; asked before each access.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        on_key: Callable[[], object],
        fd: int = 0,
        ours: Callable[[int], bool] = in_front,
    ) -> None:
        self._loop, self._on_key, self._fd, self._ours = loop, on_key, fd, ours
        self._before: list[Any] | None = None

    @property
    def watched(self) -> bool:
        """Whether a terminal is being watched for keys."""
        return self._before is not None

    def __enter__(self) -> StopKey:
        if self._ours(self._fd):
            with contextlib.suppress(OSError, termios.error):
                self._before = termios.tcgetattr(self._fd)
                tty.setcbreak(self._fd, termios.TCSANOW)  # Ctrl-C and Ctrl-Z keep their meaning
                self._loop.add_reader(self._fd, self._read)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is None:
            return
        self._loop.remove_reader(self._fd)
        if self._ours(self._fd):
            with contextlib.suppress(OSError, termios.error):
                termios.tcsetattr(self._fd, termios.TCSANOW, self._before)
        self._before = None

    def _read(self) -> None:
        if not self._ours(self._fd):
            self._loop.remove_reader(self._fd)  # moved to the background: the keys are for another process now
            return
        try:
            keys = os.read(self._fd, 1024)
        except OSError:
            keys = b""
        if keys:
            self._on_key()
        else:
            self._loop.remove_reader(self._fd)  # the terminal was closed

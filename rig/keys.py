"""Any key in the terminal stops stimulation, at any time, if a person started the program in a terminal.

Nothing is read if the program has no terminal of its own (a service, a child of `stimrig serve`), or runs in the
background, where reading would suspend the whole process.
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import tty
from collections.abc import Callable
from typing import Any, Self

BACKGROUND_S = 0.5
"""Between two looks of a program in the background at whether the terminal's keys are for it again."""
STOP_S = 8.5
"""The longest that a stop may take once the program ends."""


def in_front(fd: int) -> bool:
    """Return whether `fd` is a terminal and this process is in its foreground."""
    try:
        return os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:
        return False


class StopKey:
    """While entered, `on_key` is called for each key, without waiting for Enter; Ctrl-C and Ctrl-Z keep their meaning.

    Keys are read in a thread of their own, which calls it: nothing that the program waits for delays a stop.
    """

    def __init__(self, on_key: Callable[[], object], fd: int = 0, ours: Callable[[int], bool] = in_front) -> None:
        self._on_key, self._fd, self._ours = on_key, fd, ours
        self._before: list[Any] = []
        self._thread: threading.Thread | None = None

    @property
    def watched(self) -> bool:
        return self._thread is not None

    def __enter__(self) -> Self:
        if self._ours(self._fd):
            with contextlib.suppress(OSError, termios.error):
                self._before = termios.tcgetattr(self._fd)
                tty.setcbreak(self._fd, termios.TCSANOW)
                self._ended, self._end = os.pipe()
                self._thread = threading.Thread(target=self._listen, name="stop key", daemon=True)
                self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread is None:
            return
        os.write(self._end, b"x")
        self._thread.join(STOP_S)
        if self._ours(self._fd):
            with contextlib.suppress(OSError, termios.error):  # the terminal was closed
                termios.tcsetattr(self._fd, termios.TCSANOW, self._before)
        os.close(self._end)
        if not self._thread.is_alive():
            os.close(self._ended)

    def _listen(self) -> None:
        while True:
            ready, _, _ = select.select([self._fd, self._ended], [], [])
            if self._ended in ready:
                return
            if not self._ours(self._fd):  # moved to the background: the keys are for another process now
                if not os.isatty(self._fd):  # the terminal was closed
                    return
                if select.select([self._ended], [], [], BACKGROUND_S)[0]:
                    return
                continue
            try:
                keys = os.read(self._fd, 4096)
            except OSError:
                return
            if not keys:
                return
            self._on_key()

"""Workers without a process: what `stimrig.api.workers.process` starts for the stub, or for a real one, is a thread.

Tests of what a process does (shut in, killed, out of memory) start processes.
"""

from __future__ import annotations

import asyncio
import io
import json
import queue
import signal
import threading
import traceback
from collections.abc import Callable
from typing import Any

from stimrig.api.workers import child
from tests.api.stub_worker import Stub

STUB = ("the stub worker, as a thread",)
REAL = ("what a worker does, as a thread",)
start_process = asyncio.create_subprocess_exec


class Killed(BaseException):
    """Ends what the stub does at the moment."""


class Said(io.TextIOBase):
    """Where a worker writes: each piece is passed on."""

    def __init__(self, heard: Callable[[str], Any]) -> None:
        self.heard = heard

    def write(self, text: str) -> int:
        self.heard(text)
        return len(text)


class ThreadProcess:
    """As much of a process as a worker's owner uses; dies as one does: its output ends, its code is told."""

    def __init__(self, limit: int, *, real: bool) -> None:
        self.real = real
        self.returncode: int | None = None
        self.stdin, self.stdout = self, asyncio.StreamReader(limit)
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        self._killed = threading.Event()
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        threading.Thread(target=self._run, daemon=True).start()

    def write(self, line: bytes) -> None:
        """To its standard input."""
        self._lines.put(line)

    def kill(self) -> None:
        """As SIGKILL: it does not do its call to the end."""
        if self.returncode is not None:
            raise ProcessLookupError
        self._killed.set()
        self._lines.put(None)

    async def wait(self) -> int | None:
        """Its code, once it has ended."""
        await self._over.wait()
        return self.returncode

    def _pause(self, seconds: float) -> None:
        if self._killed.wait(seconds):
            raise Killed

    def _say(self, line: str) -> None:
        if self._killed.is_set():
            raise Killed
        self._on_loop(self.stdout.feed_data, line.encode())

    def _run(self) -> None:
        answer, code = self._real if self.real else Stub(self._pause).line, -signal.SIGKILL.value
        try:
            while (line := self._lines.get()) is not None and not self._killed.is_set():
                answer(line, self._say)
        except Killed:
            pass
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            traceback.print_exc()
            code = 1
        self._on_loop(self._end, code)

    def _real(self, line: bytes, write: Callable[[str], Any]) -> None:
        request, out = json.loads(line), Said(write)
        child.say(out, {"call": request["call"], **child.run(request, out)})

    def _end(self, code: int) -> None:
        self.returncode = code
        self.stdout.feed_eof()
        self._over.set()

    def _on_loop(self, do: Any, *arguments: Any) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(do, *arguments)


async def start(*command: str, **options: Any) -> Any:
    """In place of `asyncio.create_subprocess_exec`: those two as threads, everything else as a process."""
    if {STUB[0], REAL[0]} & set(command):
        return ThreadProcess(options["limit"], real=REAL[0] in command)
    return await start_process(*command, **options)

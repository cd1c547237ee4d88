"""The stub worker without a process: what `api.workers.process` starts for it is a thread of the test process."""

from __future__ import annotations

import asyncio
import queue
import signal
import threading
import traceback
from typing import Any

from tests.api.stub_worker import Stub

COMMAND = ("the stub worker, in the test's own process",)
start_process = asyncio.create_subprocess_exec


class Killed(BaseException):
    """Ends what the stub does at the moment."""


class StubProcess:
    """As much of a process as a worker's owner uses; dies as one does: its output ends, its code is told."""

    def __init__(self, limit: int) -> None:
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
        stub, code = Stub(self._pause), -signal.SIGKILL.value
        try:
            while (line := self._lines.get()) is not None and not self._killed.is_set():
                stub.line(line, self._say)
        except Killed:
            pass
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            traceback.print_exc()
            code = 1
        self._on_loop(self._end, code)

    def _end(self, code: int) -> None:
        self.returncode = code
        self.stdout.feed_eof()
        self._over.set()

    def _on_loop(self, do: Any, *arguments: Any) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(do, *arguments)


async def start(*command: str, **options: Any) -> Any:
    """In place of `asyncio.create_subprocess_exec`: the stub as a thread, everything else as a process."""
    if COMMAND[0] in command:
        return StubProcess(options["limit"])
    return await start_process(*command, **options)

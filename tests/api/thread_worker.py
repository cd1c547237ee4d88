"""Workers without a process: a thread does the verbs of the stub, or the real ones.

Tests of what a process does (killed, out of memory, too long) start processes.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from concurrent.futures import BrokenExecutor, Future
from functools import partial
from typing import Any

from stimrig.api.jobs import child
from stimrig.api.jobs import worker as processes
from stimrig.api.jobs.job import Job
from tests.api import stub_worker


class EndedError(BaseException):
    """Ends the verb that the stub does, as the end of its process would."""


class ThreadWorker(processes.Worker):
    """A worker whose process is a thread; it ends as a process does: its job fails, the next one gets a new thread."""

    ended: threading.Event | None = None

    code: int | None = None

    async def start(self) -> None:
        if self.ended is None or self.ended.is_set():
            self.ended, self._calls = threading.Event(), queue.SimpleQueue[Any]()
            given = self._calls, self.ended, asyncio.get_running_loop()
            threading.Thread(target=self._serve, args=given, daemon=True).start()

    async def compute(self, job: Job) -> bytes:
        answer: Future[bytes] = Future()
        self._calls.put((job, answer))
        return await asyncio.wrap_future(answer)

    def end(self) -> None:
        if self.ended is not None:
            self.ended.set()
            self._calls.put(None)

    async def close(self) -> int | None:
        return self.code

    def _serve(self, calls: Any, ended: threading.Event, loop: asyncio.AbstractEventLoop) -> None:
        def pause(seconds: float) -> None:
            if ended.wait(seconds):
                raise EndedError

        def die(code: int) -> None:
            self.code = code
            ended.set()
            raise EndedError

        stub_worker.state.pause, stub_worker.state.die = pause, die
        while (call := calls.get()) is not None:
            job, future = call
            if not future.set_running_or_notify_cancel():
                continue

            def progress(fraction: float, text: str = "", job: Job = job) -> None:
                pause(0.0)
                if not loop.is_closed():
                    loop.call_soon_threadsafe(job.advance, float(fraction), text)

            try:
                pause(0.0)
                future.set_result(child.answer(self.verbs, job.kind, progress, job.arguments))
            except EndedError:
                future.set_exception(BrokenExecutor())
                return


STUB = partial(ThreadWorker, "tests.api.stub_worker")
REAL = partial(ThreadWorker, processes.VERBS)
PROCESS = partial(processes.Worker, "tests.api.stub_worker")
"""The stub in a process."""

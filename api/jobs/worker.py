"""A worker process: a standard pool of one process. A job that is cancelled, hangs or crashes costs only itself.

A fork server has the libraries loaded already; a process forked from it inherits no socket and no connection.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs import child
from stimrig.api.jobs.job import Job, cancelled

VERBS = "stimrig.api.jobs.verbs"
PROCESSOR_S = {
    "fit": 300.0,
    "carry": 300.0,
    "diagnosis": 1200.0,  # of a long record on a slow machine
    "adaptive_begin": 10.0,
    "adaptive_advise": 5.0,
    "track": 10.0,
}
USUAL_PROCESSOR_S = 120.0
"""Processor time that a job may take; of a verb that is in the table, that one."""
WALL_FACTOR = 3.0
"""A machine that does other things, too, takes longer; then the worker is ended."""
ENVIRONMENT = (
    "PATH", "HOME", "TMPDIR", "TZ", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONSAFEPATH",
    "PYTHONDONTWRITEBYTECODE", "PYTHONUNBUFFERED", "NUMBA_CACHE_DIR", "STIMRIG_EFFECTS_DIR",
)  # fmt: skip
"""Variables that workers may see."""


def limit_environment() -> None:
    """Remove from this process's environment, which workers inherit, all that they need not see: tokens, passwords."""
    for name in set(os.environ) - set(ENVIRONMENT):
        del os.environ[name]
    # small matrices gain nothing from a second thread; a recording names no plug-in to load
    os.environ.update(OPENBLAS_NUM_THREADS="1", HDF5_PLUGIN_PRELOAD="::")


class _Context(ForkServerContext):
    """Keeps the process that the pool starts, so that it can be ended."""

    process: ForkServerProcess

    def Process(self, *arguments: Any, **more: Any) -> ForkServerProcess:  # noqa: N802  # pyright: ignore
        self.process = ForkServerProcess(*arguments, **more)
        return self.process


class Worker:
    """One process, started when it is first needed and again after it was ended.

    `verbs`: the module whose `VERBS` it does. `nice`: how far it stands back; the rig's sender goes first.
    """

    def __init__(self, verbs: str = VERBS, nice: int = 5) -> None:
        self.verbs, self.nice = verbs, nice
        self.job: Job | None = None
        self._context = _Context()
        self._executor: ProcessPoolExecutor | None = None
        self._progress: Connection | None = None
        self._number = 0
        self._killed = False

    @property
    def pid(self) -> int | None:
        """Number of the process, if there is one."""
        return None if self._executor is None else self._context.process.pid

    async def run(self, job: Job) -> dict[str, Any]:
        """Do a job to its end and return its result; its error is raised."""
        processor_s = PROCESSOR_S.get(job.kind, USUAL_PROCESSOR_S)
        try:
            await self.start()
            if job.state == "cancelled":
                raise cancelled()
            async with asyncio.timeout(WALL_FACTOR * processor_s):
                answer = json.loads(await self.compute(job, processor_s))
        except TimeoutError:
            self.end()
            await self.close()
            raise too_long(job.kind, WALL_FACTOR * processor_s) from None
        except BrokenExecutor:
            code = await self.close()
            if job.state == "cancelled":
                raise cancelled() from None
            if code == -signal.SIGXCPU:
                raise too_long(job.kind, processor_s) from None
            raise died(job.kind, code) from None
        if job.state == "cancelled":
            raise cancelled()
        if "error" in answer:
            raise job_error(job.kind, answer["error"])
        return answer["result"]

    async def start(self) -> None:
        """Start the process, unless it runs.

        Only then arguments are sent: in Python 3.11 the pool hangs where its process ends before it has read them.
        """
        if self._executor is not None and not self._killed and self._context.process.is_alive():
            return
        await self.close()
        self._killed = False
        receive: Any
        send: Any
        receive, send = self._context.Pipe(duplex=False)
        self._context.set_forkserver_preload([self.verbs])
        self._executor = ProcessPoolExecutor(1, self._context, child.begin, (send, self.verbs, self.nice))
        begun = self._executor.submit(child.ready)
        send.close()
        self._progress = receive
        asyncio.get_running_loop().add_reader(receive.fileno(), self._take_progress)
        await asyncio.wrap_future(begun)

    async def compute(self, job: Job, processor_s: float) -> bytes:
        """Have a job done; return the answer as JSON. Raises BrokenExecutor: the process ended."""
        assert self._executor is not None
        self._number += 1
        future = self._executor.submit(child.run, self._number, job.kind, job.arguments, processor_s)
        return await asyncio.wrap_future(future)

    def _take_progress(self) -> None:
        assert self._progress is not None
        try:
            number, fraction, text = json.loads(self._progress.recv_bytes())
        except (EOFError, OSError):
            self._close_pipe()
            return
        if self.job is not None and number == self._number:
            self.job.advance(fraction, text)

    def _close_pipe(self) -> None:
        if self._progress is not None:
            asyncio.get_running_loop().remove_reader(self._progress.fileno())
            self._progress.close()
            self._progress = None

    def end(self) -> None:
        """Kill the process; the job that it does fails."""
        if self._executor is not None:
            self._killed = True
            self._context.process.kill()

    async def close(self) -> int | None:
        """Wait for the process that has ended or was killed; return its exit code."""
        executor, self._executor = self._executor, None
        if executor is None:
            return None
        self._close_pipe()
        await asyncio.to_thread(executor.shutdown)
        return self._context.process.exitcode


def job_error(kind: str, error: dict[str, Any]) -> ApiError:
    """Translate the error that a worker described."""
    if error["expected"]:
        extra = {key: error[key] for key in ("place", "fix") if error.get(key)}
        return ApiError(422, "data", "The data do not allow this", error["detail"], **extra)
    detail = f"{error['detail']}. Your data are safe. See logs/api.log."
    return ApiError(500, "analysis-failed", f"The {kind} failed", detail)


def too_long(kind: str, seconds: float) -> ApiError:
    """Return the error of a job that was ended because it computed for too long."""
    detail = f"The {kind} was ended after {seconds:g} s. Cut the recording, or resample it to a lower rate."
    return ApiError(422, "data", "The data do not allow this", detail)


def died(kind: str, code: int | None) -> ApiError:
    """Return the error of a job whose process ended."""
    how = f"It was ended by {signal.Signals(-code).name}" if code and code < 0 else f"It ended with code {code}"
    detail = f"{how} while it did the {kind}. Your data are safe. Try again, or see logs/api.log."
    return ApiError(500, "worker-died", "The worker process died", detail)

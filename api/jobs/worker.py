"""A worker: a process that does jobs one after the other. One that is cancelled, hangs or crashes costs only itself."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from concurrent.futures import BrokenExecutor
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs import child
from stimrig.api.jobs.job import Job, cancelled
from stimrig.api.jobs.process import Process

VERBS = "stimrig.api.jobs.verbs"
LIMITS_S = {
    "fit": 900.0,
    "carry": 900.0,
    "diagnosis": 3600.0,  # of a long record on a slow machine
    "adaptive_begin": 60.0,  # of a busy machine; a test goes on by its fixed plan before that
    "adaptive_advise": 60.0,
    "track": 60.0,
}
USUAL_LIMIT_S = 360.0
"""So long a job may take, by the clock; of a verb that is in the table, that one. Then its process is ended."""
ENVIRONMENT = (
    "PATH", "HOME", "TMPDIR", "TZ", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONSAFEPATH",
    "PYTHONDONTWRITEBYTECODE", "PYTHONUNBUFFERED", "NUMBA_CACHE_DIR", "STIMRIG_EFFECTS_DIR",
)  # fmt: skip
"""Variables that workers may see."""
KEPT_MEMORY = dict.fromkeys(("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"), str(1 << 25))
"""Memory below this size is kept once it is free: a fit makes and drops arrays all the time."""


def limit_environment() -> None:
    """Remove from this process's environment, which workers inherit, all that they need not see: tokens, passwords."""
    for name in set(os.environ) - set(ENVIRONMENT):
        del os.environ[name]
    # small matrices gain nothing from a second thread; a recording names no plug-in to load
    os.environ.update(OPENBLAS_NUM_THREADS="1", HDF5_PLUGIN_PRELOAD="::", **KEPT_MEMORY)


class Worker:
    """One process, started when it is first needed and again after it was ended.

    `verbs`: the module whose `VERBS` it does. `nice`: how far it stands back; the rig's sender goes first.
    """

    def __init__(self, verbs: str = VERBS, nice: int = 5) -> None:
        self.verbs = verbs
        self.process = Process([verbs], child.MEMORY_BYTES, nice)
        self.job: Job | None = None
        self._number = 0

    async def run(self, job: Job) -> dict[str, Any]:
        """Do a job to its end and return its result; its error is raised."""
        limit_s = LIMITS_S.get(job.kind, USUAL_LIMIT_S)
        try:
            await self.start()
            if job.state == "cancelled":
                raise cancelled()
            async with asyncio.timeout(limit_s):
                answer = json.loads(await self.compute(job))
        except TimeoutError:
            self.end()
            await self.close()
            words = f"The {job.kind} was ended after {limit_s:g} s. "
            words += "If the machine is not busy, cut the recording, or lower its rate."
            raise ApiError(422, "data", "The data do not allow this", words) from None
        except BrokenExecutor:
            code = await self.close()
            raise (cancelled() if job.state == "cancelled" else died(job.kind, code)) from None
        if job.state == "cancelled":
            raise cancelled()
        if "error" in answer:
            raise ApiError(**answer["error"])
        return answer["result"]

    async def start(self) -> None:
        """Start the process, unless it runs."""
        if not self.process.ready:
            await self.close()
            begun = self.process.start()
            assert self.process.progress is not None
            asyncio.get_running_loop().add_reader(self.process.progress.fileno(), self._take_progress)
            await asyncio.wrap_future(begun)

    async def compute(self, job: Job) -> bytes:
        """Have a job done; return the answer as JSON. Raises BrokenExecutor: the process ended."""
        self._number += 1
        return await asyncio.wrap_future(
            self.process.submit(child.run, self._number, self.verbs, job.kind, job.arguments)
        )

    def _take_progress(self) -> None:
        assert self.process.progress is not None
        try:
            number, fraction, text = json.loads(self.process.progress.recv_bytes())
        except (EOFError, OSError):
            self._stop_reading()
            return
        if self.job is not None and number == self._number:
            self.job.advance(fraction, text)

    def _stop_reading(self) -> None:
        pipe = self.process.progress
        if pipe is not None and not pipe.closed:
            asyncio.get_running_loop().remove_reader(pipe.fileno())

    def end(self) -> None:
        """Kill the process; the job that it does fails."""
        self.process.kill()

    async def close(self) -> int | None:
        """Wait for the process that has ended or was killed; return its exit code."""
        self._stop_reading()
        return await asyncio.to_thread(self.process.close)


def died(kind: str, code: int | None) -> ApiError:
    """Return the error of a job whose process ended; of SIGKILL only somebody else can be the cause."""
    if code == -signal.SIGKILL:
        detail = f"SIGKILL ended it while it did the {kind}, as the system does where memory runs short. Try again."
        return ApiError(503, "worker-died", "The worker process was killed from outside", detail)
    how = f"It was ended by {signal.Signals(-code).name}" if code and code < 0 else f"It ended with code {code}"
    detail = f"{how} while it did the {kind}. Your data are safe. Try again, or see logs/api.log."
    return ApiError(500, "worker-died", "The worker process died", detail)

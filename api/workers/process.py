"""One worker process: started with nothing but what it needs, told a call at a time, ended when it takes too long."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.logs import current_test

log = logging.getLogger("stimrig.fitting")

WORKER = (sys.executable, "-m", "stimrig.api.workers.child")
BACKGROUND_NICE = "15"
"""How far a worker for what nobody waits for stands back."""
LINE_LIMIT = 64 * 1024 * 1024
PASSED_ON = (
    "PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "PYTHONUNBUFFERED",
    "NUMBA_CACHE_DIR", "OPENBLAS_NUM_THREADS", "STIMRIG_EFFECTS_DIR",
)  # fmt: skip
"""All of the service's environment that a worker gets: no token, no setting of the service, nothing unexpected."""
PROCESSOR_S = {
    "fit": 300.0,
    "carry": 300.0,
    "effects": 60.0,
    "export_csv": 120.0,
    "plain_csv": 120.0,
    "find_recording": 120.0,
    "join": 120.0,
    "invert": 60.0,
    "adaptive_outlook": 60.0,
    "adaptive_begin": 10.0,
    "adaptive_advise": 5.0,
    "track": 10.0,
    "track_warm": 60.0,
}
LONGEST_PROCESSOR_S = 1200.0
"""What a call may compute; improving a long record takes minutes on a slow machine."""
LEAST_SHARE = 0.05
"""Before so much is done a call has no pace."""
WALL_FACTOR = 3.0
"""A machine that does other things, too, takes longer; then the worker is ended."""


def environment() -> dict[str, str]:
    """The environment of a worker; it imports what this process imports, and nothing from the working folder."""
    kept = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
    ours = str(Path(__file__).absolute().parents[3])
    path = os.pathsep.join(dict.fromkeys([ours, *kept.get("PYTHONPATH", "").split(os.pathsep)])).rstrip(os.pathsep)
    return {**kept, "PYTHONPATH": path, "PYTHONSAFEPATH": "1", "HDF5_PLUGIN_PRELOAD": "::"}


class Places:
    """The folders that stay open to workers; a call that names another one makes it known.

    `reads`, `writes`: known from the start.
    """

    def __init__(self, reads: Iterable[Path] = (), writes: Iterable[Path] = ()) -> None:
        self.reads, self.writes = {path.absolute() for path in reads}, {path.absolute() for path in writes}

    def arguments(self) -> tuple[str, ...]:
        sides = (("--reads", self.reads), ("--writes", self.writes))
        return tuple(part for option, paths in sides for path in sorted(paths) for part in (option, str(path)))

    def learn(self, arguments: dict[str, Any]) -> None:
        """Take in the folders of a call's files: recordings of a rig that runs by itself lie where that rig says."""
        files = [arguments.get("data"), *(arguments.get("parts") or [])]
        wanted = {Path(file).absolute().parent for file in files if file}
        wanted |= {Path(arguments["folder"]).absolute()} if arguments.get("folder") else set()
        self.reads |= {path for path in wanted if not _covered(path, self.reads)}
        if arguments.get("out") and not _covered(out := Path(arguments["out"]).absolute().parent, self.writes):
            self.writes.add(out)


def _covered(path: Path, known: set[Path]) -> bool:
    return any(path == each or each in path.parents for each in known)


@dataclass
class Call:
    """One call: what, how far, and a future for its result."""

    id: int
    verb: str
    arguments: dict[str, Any]
    urgent: bool = False
    background: bool = False
    state: str = "queued"
    progress: float = 0.0
    text: str = ""
    expected_s: float = math.inf
    """How long its pace says that it takes in all: the least that was said so far."""
    started_s: float | None = None
    result: asyncio.Future[dict[str, Any]] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    on_progress: Callable[[Call], None] | None = None
    test_id: str | None = field(default_factory=current_test.get)

    @property
    def elapsed_s(self) -> float:
        """Time since it began, s; 0 while it is queued."""
        return 0.0 if self.started_s is None else time.monotonic() - self.started_s

    @property
    def time_left_s(self) -> float | None:
        """What its pace so far says, s: never more than was said before; 0 once that is over; None before a pace."""
        if self.state != "running" or self.expected_s == math.inf:
            return None
        return max(0.0, self.expected_s - self.elapsed_s)

    def advance(self, progress: float, text: str) -> None:
        """Take in how far it is."""
        self.progress, self.text = progress, text
        if progress >= LEAST_SHARE:
            self.expected_s = min(self.expected_s, self.elapsed_s / progress)

    def document(self) -> dict[str, Any]:
        """What a client sees of it."""
        left = self.time_left_s
        return {
            "verb": self.verb,
            "state": self.state,
            "progress": round(self.progress, 3),
            "text": self.text,
            "elapsed_s": round(self.elapsed_s, 1),
            "time_left_s": None if left is None else round(left, 1),
        }


class Worker:
    """One worker process, started when first needed and again after a call was cancelled."""

    def __init__(self, command: tuple[str, ...], places: Places, *, background: bool = False) -> None:
        self.command, self.places, self.background = command, places, background
        self.started_with: tuple[str, ...] = ()
        self.process: asyncio.subprocess.Process | None = None
        self.call: Call | None = None

    async def start(self) -> asyncio.subprocess.Process:
        """The running process, fresh if there is none, or if the one there is cannot reach a folder it needs now."""
        arguments = self.places.arguments()
        if self.process is not None and self.process.returncode is None and self.started_with != arguments:
            await self.close()
        if self.process is None or self.process.returncode is not None:
            command = ("nice", "-n", BACKGROUND_NICE, *self.command) if self.background else self.command
            self.process = await asyncio.create_subprocess_exec(
                *command, *arguments, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=LINE_LIMIT,
                env=environment(),
            )  # fmt: skip
            self.started_with = arguments
        return self.process

    async def run(self, call: Call) -> dict[str, Any]:
        """Do a call to its end; its result, or its error raised."""
        self.places.learn(call.arguments)
        process = await self.start()
        if call.state == "cancelled":  # before there was a process to end
            await self.close()
            raise cancelled()
        processor_s = PROCESSOR_S.get(call.verb, LONGEST_PROCESSOR_S)
        request = {"call": call.id, "verb": call.verb, "arguments": call.arguments, "processor_s": processor_s}
        try:
            async with asyncio.timeout(WALL_FACTOR * processor_s):
                found = await self._converse(process, request, call)
                if found is not None:
                    return found
                await process.wait()
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            # no line of ours: this worker is not one to go on with
            await self.close()
            detail = "Its answer cannot be read. Your data are safe. Try again, or see logs/api.log."
            raise ApiError(500, "worker-died", "The worker process was ended", detail) from error
        except TimeoutError:
            await self.close()
            raise too_long(call.verb, WALL_FACTOR * processor_s) from None
        if call.state == "cancelled":
            raise cancelled()
        if process.returncode == -signal.SIGXCPU:
            raise too_long(call.verb, processor_s)
        how = f"{ending(process.returncode)} while it did the {call.verb}"
        detail = f"{how}. Your data are safe. Try again, or see logs/api.log."
        raise ApiError(500, "worker-died", "The worker process died", detail)

    async def _converse(
        self, process: asyncio.subprocess.Process, request: dict[str, Any], call: Call
    ) -> dict[str, Any] | None:
        """Ask and listen; None where the process ended without an answer."""
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(request).encode() + b"\n")
        while line := await process.stdout.readline():
            message = json.loads(line)
            if left_open := message.get("left_open"):
                log.warning("a worker is not shut in: %s (see stimrig doctor)", left_open)
            if message.get("call") != call.id:
                continue
            if "result" in message:
                return dict(message["result"])
            if "error" in message:
                raise call_error(call.verb, message["error"])
            if not math.isfinite(fraction := float(message["progress"])):
                raise ValueError(fraction)
            call.advance(fraction, str(message["text"]))
            if call.on_progress is not None:
                call.on_progress(call)
        return None

    def kill(self) -> None:
        if self.process is not None and self.process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.kill()

    async def close(self) -> None:
        self.kill()
        if self.process is not None:
            await self.process.wait()


def call_error(verb: str, error: dict[str, Any]) -> ApiError:
    """A worker's error as a problem."""
    if error.get("expected"):
        extra = {key: error[key] for key in ("place", "fix") if error.get(key)}
        return ApiError(422, "data", "The data do not allow this", error["detail"], **extra)
    detail = f"{error['detail']}. Your data are safe. See logs/api.log."
    return ApiError(500, "analysis-failed", f"The {verb} failed", detail)


def cancelled() -> ApiError:
    return ApiError(409, "cancelled", "The job was cancelled", "Start it again if it is still wanted.")


def too_long(verb: str, seconds: float) -> ApiError:
    """A call that was ended because it computed for too long."""
    detail = f"The {verb} was ended after {seconds:g} s. Cut the recording, or resample it to a lower rate."
    return ApiError(422, "data", "The data do not allow this", detail)


def ending(code: int | None) -> str:
    """How a process ended, in words."""
    if code is not None and code < 0:
        return f"It was ended by {signal.Signals(-code).name}"
    return f"It ended with code {code}"

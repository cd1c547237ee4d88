"""One warm process with limits on memory and files, for calls that read files which anybody may have made.

A call that exhausts a limit, hangs or crashes costs itself alone: the next one gets another process. `Process` is a
standard pool of one: where one process of a pool of several ends, all calls of the pool fail.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from importlib import import_module
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any

LIMITS = {resource.RLIMIT_FSIZE: 512 * 2**20, resource.RLIMIT_NOFILE: 256, resource.RLIMIT_CORE: 0}
PR_SET_PDEATHSIG = 1


class _Context(ForkServerContext):
    """A fork server has the libraries loaded; a process of it inherits no socket. Keeps the one that a pool starts."""

    process: ForkServerProcess

    def Process(self, *arguments: Any, **more: Any) -> ForkServerProcess:  # noqa: N802  # type: ignore
        self.process = ForkServerProcess(*arguments, **more)
        return self.process


class Process:
    """A pool of one process, which is started by `start` and ended by `kill` or by its work.

    `modules`: loaded before the memory is limited; `memory_bytes`: what calls may take beyond these; `nice`: how far it
    stands back; `most_calls`: after so many it is replaced, so that what a library never gives back does not add up.
    """

    def __init__(self, modules: Sequence[str], memory_bytes: int, nice: int = 0, most_calls: int = 10**9) -> None:
        self.modules, self.limits, self.most_calls = list(modules), (memory_bytes, nice), most_calls
        self.progress: Connection | None = None
        """Where the process reports (`report`)."""
        self._context, self._executor, self._calls, self._killed = _Context(), None, 0, False
        self._executor: ProcessPoolExecutor | None

    @property
    def pid(self) -> int | None:
        """Number of the process, if there is one."""
        return None if self._executor is None else self._context.process.pid

    @property
    def ready(self) -> bool:
        """True while it can do another call."""
        usable = self._executor is not None and not self._killed and self._calls < self.most_calls
        return usable and self._context.process.is_alive()

    def start(self) -> Future[int]:
        """Start the process, which is closed; await it before a call.

        Python 3.11 hangs where a process ends before it has read its arguments.
        """
        receive: Any
        send: Any
        receive, send = self._context.Pipe(duplex=False)
        self._context.set_forkserver_preload(self.modules)
        self._executor = ProcessPoolExecutor(1, self._context, _begin, (send, self.modules, *self.limits))
        self.progress, self._calls, self._killed = receive, 0, False
        begun = self._executor.submit(os.getpid)
        send.close()
        return begun

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Call a function of a module; the future raises BrokenExecutor where the process ends."""
        assert self._executor is not None
        self._calls += 1
        return self._executor.submit(function, *arguments)

    def kill(self) -> None:
        """End the process; its call fails."""
        if self._executor is not None:
            self._killed = True
            self._context.process.kill()

    def close(self) -> int | None:
        """Wait until the process has ended; return its exit code."""
        executor, self._executor = self._executor, None
        if executor is None:
            return None
        executor.shutdown()
        if self.progress is not None:
            self.progress.close()
        return self._context.process.exitcode


class _Child:
    """Arguments of the process itself."""

    progress: Connection


def _begin(progress: Connection, modules: list[str], memory_bytes: int, nice: int) -> None:
    """Initialise the process: end with the one that started it, load the modules, set the limits."""
    os.dup2(2, 1)  # what a library prints is no line of the service
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process
    # It ends with the fork server, and that one with its parent: once nobody but the parent holds this pipe.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    os.close(forkserver._forkserver._forkserver_alive_fd)  # type: ignore
    os.nice(nice)
    _Child.progress = progress
    for name in modules:
        import_module(name)
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])  # of addresses, as RLIMIT_AS counts them
    for kind, limit in {**LIMITS, resource.RLIMIT_AS: pages * resource.getpagesize() + memory_bytes}.items():
        hard = resource.getrlimit(kind)[1]
        value = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (value, value))


def report(message: bytes) -> None:
    """Send a message from the process to `Process.progress`."""
    _Child.progress.send_bytes(message)

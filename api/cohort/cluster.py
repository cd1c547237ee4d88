"""The workers: processes of this machine, or those of a scheduler of Dask that stands elsewhere."""

from __future__ import annotations

import importlib.metadata
import logging
import platform
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any

from dask import config
from dask.utils import parse_bytes
from distributed import Client, LocalCluster
from distributed.comm.core import CommClosedError
from distributed.security import Security

from stimrig.api.cohort.tasks import SCHEDULER_GONE, CohortError, CutOffError
from stimrig.api.version import software_version

CONNECT_S = 15.0
LEAST_MEMORY_BYTES = 256 * 2**20
WORKER_BYTES = 2**30
"""What a worker's own process may take: it holds one record's bytes and no more."""
LOST_WORKERS = 2
"""A record that so many workers are lost with, and one more, is a row that says so."""


@dataclass(frozen=True)
class Workers:
    """Where the records are computed."""

    scheduler: str = ""  # address of a scheduler; empty: this machine
    count: int = 2  # processes on this machine
    memory_bytes: int = 2**30  # what a record may take beyond the libraries
    wait_s: float = 60.0  # how long to wait for the first worker of a scheduler


def memory_of(text: str) -> int:
    """Bytes of a size such as 1GB or 800MiB. Raises CohortError: it is none, or too small for any fit."""
    try:
        found = parse_bytes(text)
    except (ValueError, TypeError):
        raise CohortError(f"--memory {text}: give a size, as 1GB.") from None
    if not LEAST_MEMORY_BYTES <= found <= 2**40:
        raise CohortError(f"--memory {text}: give {LEAST_MEMORY_BYTES // 2**20} MiB or more, as 1GB.")
    return found


@contextmanager
def connected(workers: Workers) -> Iterator[Client]:
    """A client whose workers are there and have this version; all that was started is ended.

    Raises CohortError: no scheduler, no worker, or workers of another version. CutOffError: the scheduler went while it
    was asked for something.
    """
    quiet()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with _remote(workers) if workers.scheduler else _local(workers) as client:
                if workers.scheduler:
                    check_versions(client)
                yield client
        except CommClosedError:
            raise CutOffError(SCHEDULER_GONE) from None


def quiet() -> None:
    """Keep Dask's log from the terminal: what matters to the person is said in one line."""
    for name in ("distributed", "tornado", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


@contextmanager
def _local(workers: Workers) -> Iterator[Client]:
    settings = {
        "distributed.scheduler.allowed-failures": LOST_WORKERS,
        "distributed.comm.timeouts.connect": "10s",
        "distributed.nanny.pre-spawn-environ": {"OPENBLAS_NUM_THREADS": 1, "OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1},
    }
    with config.set(settings), _without_ctrl_c():
        cluster = LocalCluster(
            n_workers=workers.count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            memory_limit=max(WORKER_BYTES, workers.memory_bytes),
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
            silence_logs=logging.CRITICAL,
            security=Security.temporary(),  # whoever reaches an open scheduler's port runs programs as its user
        )
    with config.set(settings), cluster, Client(cluster) as client:
        yield client


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Threads and processes that are started within never see Ctrl-C; here it comes when they are there.

    A terminal sends it to every process. This one ends the others in order; each of them would write a traceback.
    """
    resource_tracker.ensure_running()  # it lets Ctrl-C through in the thread that first needs it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _remote(workers: Workers) -> Iterator[Client]:
    address = workers.scheduler
    try:
        client = Client(address, timeout=CONNECT_S, name="stimrig-cohort")
    except (OSError, TimeoutError, ValueError, TypeError, ImportError, RuntimeError) as error:
        words = " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
        fix = "Is `dask scheduler` running there, with the same version of Dask?"
        raise CohortError(f"--scheduler {address}: no scheduler answers ({words}). {fix}") from None
    quiet()  # a client makes loggers of its own
    with client:
        try:
            client.wait_for_workers(1, timeout=workers.wait_s)
        except TimeoutError:
            fix = "Start some with `dask worker`, or give more time with --wait."
            raise CohortError(f"--scheduler {address}: no worker within {workers.wait_s:g} s. {fix}") from None
        yield client


def check_versions(client: Client) -> None:
    """Refuse workers whose stimrig or Python is another one. Raises CohortError: names the first such worker."""
    asked = (("stimrig", software_version(), importlib.metadata.version, ("stimrig",)),
             ("Python", platform.python_version(), platform.python_version, ()))  # fmt: skip
    for what, mine, ask, arguments in asked:
        found: Any = client.run(ask, *arguments, on_error="return")
        for worker, theirs in found.items():
            if not isinstance(theirs, str):
                raise CohortError(f"worker {worker}: no {what} there. Install stimrig[cohort] {software_version()}.")
            same = theirs == mine if what == "stimrig" else theirs.split(".")[:2] == mine.split(".")[:2]
            if not same:
                raise CohortError(f"worker {worker}: {what} {theirs}, here {mine}. Install the same version there.")


def lanes(client: Client) -> int:
    """Records that are computed at the same time, now: workers may come and go."""
    threads: Any = client.nthreads()
    return max(1, sum(threads.values()))

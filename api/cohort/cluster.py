"""The workers of a run: processes of this machine, or those of a scheduler of Dask that stands elsewhere."""

from __future__ import annotations

import logging
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

from dask import config
from dask.utils import parse_bytes
from distributed import Client, LocalCluster
from distributed.comm.core import CommClosedError
from distributed.security import Security

from stimrig.api.cohort.errors import SCHEDULER_GONE, CohortError, InterruptedRunError

CONNECT_S = 15.0
MIN_MEMORY_BYTES = 256 * 2**20
SETTINGS = {
    "distributed.scheduler.allowed-failures": 2,  # of workers that are lost with a record
    "distributed.comm.timeouts.connect": "10s",
    "distributed.nanny.pre-spawn-environ": {"OPENBLAS_NUM_THREADS": 1, "OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1},
}


def parse_memory(text: str) -> int:
    """Return the bytes of a size such as 1GB or 800MiB. Raises CohortError: it is none, or too small for a fit."""
    try:
        memory_bytes = parse_bytes(text)
    except (ValueError, TypeError):
        raise CohortError(f"--memory {text}: give a size, as 1GB.") from None
    if not MIN_MEMORY_BYTES <= memory_bytes <= 2**40:
        raise CohortError(f"--memory {text}: give {MIN_MEMORY_BYTES // 2**20} MiB or more, as 1GB.")
    return memory_bytes


@contextmanager
def connect(scheduler: str = "", workers: int = 2, wait_s: float = 60.0) -> Iterator[Client]:
    """Give a client whose workers are there; end all that was started.

    `scheduler`: its address; empty: this many `workers` of this machine; `wait_s`: for the first worker of a scheduler.

    Raises CohortError: no scheduler, or no worker. InterruptedRunError: the scheduler went.
    """
    _silence_dask()
    with warnings.catch_warnings(), config.set(SETTINGS):
        warnings.simplefilter("ignore")
        try:
            with _connect_to(scheduler, wait_s) if scheduler else _start_workers(workers) as client:
                yield client
        except CommClosedError:
            raise InterruptedRunError(SCHEDULER_GONE) from None


def _silence_dask() -> None:
    """Keep Dask's log from the terminal: what matters to the person is said in one line."""
    for name in ("distributed", "tornado", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


@contextmanager
def _start_workers(count: int) -> Iterator[Client]:
    # A terminal sends Ctrl-C to every process. The workers must not see it: this process ends them in order.
    resource_tracker.ensure_running()  # it unblocks the signal in the thread that first needs it
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            memory_limit="1GiB",  # of the worker itself, which holds the bytes of one record
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
            security=Security.temporary(),  # whoever reaches an open scheduler's port runs programs as its user
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
    with cluster, Client(cluster) as client:
        yield client


@contextmanager
def _connect_to(address: str, wait_s: float) -> Iterator[Client]:
    try:
        client = Client(address, timeout=CONNECT_S, name="stimrig-cohort")
    except (OSError, TimeoutError, ValueError, TypeError, ImportError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
        remedy = "Is `dask scheduler` running there, with the same version of Dask?"
        raise CohortError(f"--scheduler {address}: no scheduler answers ({reason}). {remedy}") from None
    _silence_dask()  # a client makes loggers of its own
    with client:
        try:
            client.wait_for_workers(1, timeout=wait_s)
        except TimeoutError:
            remedy = "Start some with `dask worker`, or give more time with --wait."
            raise CohortError(f"--scheduler {address}: no worker within {wait_s:g} s. {remedy}") from None
        yield client

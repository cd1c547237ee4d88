"""Jobs in worker processes: cancelled, urgent first, and a hostile file costs its job and nothing else."""

from __future__ import annotations

import asyncio
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import stimrig
from stimrig.api.errors import ApiError
from stimrig.api.jobs import pool as pools
from stimrig.api.jobs import worker
from stimrig.api.jobs.job import Job
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.process import LIMITS
from stimrig.api.jobs.worker import Worker
from tests.api.conftest import soon
from tests.api.fake_rig import default_widths, muscle
from tests.api.thread_worker import PROCESS, STUB
from tests.harness import hostile_shapes

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]


def with_pool(work: Callable[[Pool], Awaitable[Any]], made: Any = STUB, workers: int = 1, **more: Any) -> Any:
    """Run a coroutine function with a pool."""

    async def run() -> Any:
        pool = Pool(workers, made, **more)
        try:
            async with asyncio.timeout(120):
                return await work(pool)
        finally:
            await pool.close()

    return asyncio.run(run())


def pooled(*given: Any, **how: Any) -> Callable[[Callable[[Pool], Any]], Callable[[], None]]:
    """Give a test a pool and an event loop."""
    return lambda test: lambda: with_pool(test, *given, **how)


async def refused(job: Job, match: str) -> ApiError:
    with pytest.raises(ApiError, match=match) as caught:
        await job.result
    return caught.value


async def running(job: Job) -> Job:
    while job.progress < 0.5:
        await asyncio.sleep(0.01)
    return job


async def _is_cancelled_at_once(pool: Pool) -> None:
    for _ in range(2):  # while its process starts, and while the process waits for work
        job = pool.submit("fit", data="x", effects=["slow"])
        pool.cancel(job)
        await refused(job, "cancelled")
        assert job.state == "cancelled"
        assert (await pool.submit("effects").result)["effects"], "the worker does the next job"


async def _is_cancelled_while_it_runs(pool: Pool) -> None:
    job = await running(pool.submit("fit", data="x", effects=["slow"]))
    pool.cancel(job)
    await refused(job, "cancelled")
    assert (await pool.submit("fit", data="x").result)["model"]["method"] == "maximum-likelihood"


@pytest.mark.parametrize("work", [_is_cancelled_at_once, _is_cancelled_while_it_runs])
@pytest.mark.parametrize("made", [STUB, PROCESS], ids=["thread", "process"])
def test_a_job(work: Any, made: Any) -> None:
    with_pool(work, made)


@pooled()
async def test_a_queued_job_is_cancelled(pool: Pool) -> None:
    slow, queued = pool.submit("fit", data="x", effects=["slow"]), pool.submit("fit", data="x")
    pool.cancel(queued)
    await refused(queued, "cancelled")
    assert (slow.state, queued.state) == ("running", "cancelled")


@pooled(workers=2)
async def test_the_fit_after_a_test_goes_first_and_has_a_worker_kept_free(pool: Pool) -> None:
    blocking = [pool.submit("fit", data="x", effects=["slow"]) for _ in range(3)]
    assert (await pool.submit("fit", urgent=True, data="x").result)["model"]
    assert sum(job.state == "running" for job in blocking) == 1


@pooled()
async def test_the_curves_of_pages_wait_behind_a_fit_and_before_a_diagnosis(pool: Pool) -> None:
    pool.submit("fit", data="x", effects=["slow"])
    for kind in ("diagnosis", "fit", "curves", "comparison"):
        pool.submit(kind, urgent=kind != "diagnosis", data="x")
    assert [job.kind for job in pool.queue] == ["fit", "comparison", "curves", "diagnosis"]


@pooled()
async def test_a_job_that_nobody_awaits_any_more_is_cancelled(pool: Pool) -> None:
    running, queued = (asyncio.ensure_future(wait_for(pool)) for _ in range(2))
    await asyncio.sleep(0)
    for waiter in (queued, running):
        waiter.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiter
    assert (await pool.submit("effects").result)["effects"], "it waits for neither of them"


async def wait_for(pool: Pool) -> Any:
    return await pool.submit("fit", data="x", effects=["slow"]).result


@pooled()
async def test_too_many_jobs_are_refused_but_urgent_ones(pool: Pool) -> None:
    for _ in range(1 + pools.MOST_QUEUED):
        pool.submit("fit", data="x", effects=["slow"])
    with pytest.raises(ApiError) as caught:
        pool.submit("fit", data="x")
    assert (caught.value.status, int(caught.value.headers["Retry-After"]) > 0) == (503, True)
    assert pool.submit("fit", urgent=True, data="x").state == "queued"


@pooled()
async def test_an_expected_error_names_its_place(pool: Pool) -> None:
    error = await refused(pool.submit("fit", data="x", effects=["bad"]), "no effect bad")
    assert error.status == 422 and error.extra["place"] == "effects"


def test_the_time_that_is_left_never_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither while nothing is heard, nor where a step takes longer than the ones before."""
    now_s = 100.0
    monkeypatch.setattr("stimrig.api.jobs.job.time.monotonic", lambda: now_s)

    async def left() -> list[float | None]:
        nonlocal now_s
        fit, found = Job("fit"), []
        fit.start()
        for at_s, progress in ((101, 0.01), (102, 0.1), (105, None), (110, 0.2), (111, 0.5), (121, None), (130, 0.6)):
            now_s = float(at_s)
            if progress is not None:
                fit.advance(progress, "")
            found.append(fit.time_left_s)
        return found

    assert asyncio.run(left()) == pytest.approx([None, 18.0, 15.0, 10.0, 9.0, 0.0, 0.0])


HOSTILE = [
    ("memory", 422, "more than 1536 MB"), ("loop", 422, "was ended after 1 s"), ("output", 422, "more than 1536 MB"),
    ("file", 500, "OSError"), ("crash", 500, "SIGSEGV"), ("killed", 503, "where memory runs short"),
    ("exit", 500, "SystemExit"), ("recursion", 500, "RecursionError"),
]  # fmt: skip


def test_a_hostile_file_costs_its_job_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The job after it has a process again."""

    async def work(pool: Pool) -> None:
        for does, status, says in HOSTILE:
            monkeypatch.setitem(worker.LIMITS_S, "hostile", 1.0 if does == "loop" else 60.0)
            error = await refused(pool.submit("hostile", data=does), ".")
            assert error.status == status and says in error.detail, does
            assert (await pool.submit("effects").result)["effects"]

    with_pool(work, PROCESS)


LOOK = """
import asyncio, json, os, sys
from pathlib import Path
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.process import LIMITS
from stimrig.api.jobs.worker import limit_environment
from tests.api.thread_worker import PROCESS

async def main():
    limit_environment()
    held = os.open(os.devnull, os.O_RDONLY)
    os.set_inheritable(held, True)
    pool = Pool(1, PROCESS)
    await pool.submit("effects").result
    pid = pool.workers[0].process.pid
    print(json.dumps([pid, held]), flush=True)
    sys.stdin.read()
    pool.submit("fit", data="x", effects=["slow"])
    await asyncio.sleep(3600)

asyncio.run(main())
"""


def test_a_worker_has_no_secret_is_limited_and_ends_with_the_service() -> None:
    secrets = dict.fromkeys(("STIMRIG_ADMIN_TOKEN", "STIMRIG_DATABASE_URL", "SOME_PASSWORD"), "secret-of-the-test")
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    service = subprocess.Popen([sys.executable, "-c", LOOK], cwd=ROOT, env={**os.environ, **secrets}, **pipes)
    try:
        assert service.stdout is not None
        pid, held = json.loads(service.stdout.readline())
        process = Path(f"/proc/{pid}")
        assert "secret-of-the-test" not in (process / "environ").read_text()
        assert not (process / "fd" / str(held)).exists() or (process / f"fd/{held}").readlink() != Path(os.devnull)
        links = [str(link.readlink()) for link in (process / "fd").iterdir()]
        assert not [link for link in links if link.startswith("socket:")]
        limits = {line[:26].strip(): line[26:].split()[0] for line in (process / "limits").read_text().splitlines()}
        assert int(limits["Max address space"]) < 2**34
        assert int(limits["Max file size"]) == LIMITS[resource.RLIMIT_FSIZE]
        assert (limits["Max open files"], limits["Max core file size"]) == ("256", "0")
        os.kill(pid, signal.SIGSTOP)  # only the kernel can end it
    finally:
        service.kill()
        service.communicate()
    soon(lambda: not process.exists() or " Z " in (process / "stat").read_text(), 20)


def test_hostile_files_through_a_worker(tmp_path: Path) -> None:
    """A few of each kind that libhdf5 or the memory could die of: refused in one line, or read as sound."""
    beside, uploads, rng = tmp_path / "service", tmp_path / "uploads", random.Random(3)
    beside.mkdir()
    uploads.mkdir()
    picked = ("gzip bomb", "virtual over raw storage", "external storage /proc/self/environ")
    files = [
        *hostile_shapes.hdf5_shapes(beside, only=picked),
        *(one for one in hostile_shapes.csv_shapes() if one.name == "a million columns"),
        hostile_shapes.Hostile("sound", ".h5", hostile_shapes.good(), refused=False),
        *(hostile_shapes.spoiled(rng, number) for number in range(6)),
    ]

    async def work(pool: Pool) -> list[str]:
        refused = []
        for hostile in files:
            path = uploads / f"upload{hostile.suffix}"
            path.write_bytes(hostile.content)
            try:
                found = json.dumps(await pool.submit("fit", data=str(path)).result)
                assert not hostile.refused, f"{hostile.name} was taken as sound"
            except ApiError as error:
                found = error.detail
                assert (error.status, error.code != "worker-died") == (422, True), (hostile.name, found)
                assert "\n" not in found and len(found) < 400, (hostile.name, found)
                refused.append(hostile.name)
            assert hostile_shapes.SECRET[:20].decode() not in found, hostile.name
        return refused

    assert 4 <= len(with_pool(work, Worker)) < len(files)


def made_up_csv(path: Path) -> Path:
    """A record of the fake rig's muscle at 40 Hz."""
    widths, segments = default_widths()
    torque = muscle(widths, 400.0)[9::10]
    names = [next(s["name"] for s in segments if s["start_s"] <= k / 40 < s["end_s"]) for k in range(len(widths))]
    rows = [f"{k / 40},{widths[k]},{torque[k]:.6f},{names[k]}" for k in range(len(widths))]
    path.write_text("time_s,pulse_width_us,torque_nm,segment\n" + "\n".join(rows) + "\n")
    return path


def test_real_worker_fits_draws_and_tells_bad_data(tmp_path: Path) -> None:
    """Of a Parquet file, too: what reads it opens more files than the reader of tables."""
    pytest.importorskip("pyarrow", reason="pip install pyarrow")
    good, bad = made_up_csv(tmp_path / "good.csv"), tmp_path / "bad.csv"
    bad.write_text("time_s,pulse_width_us,segment\n0,0,prbs\n")
    parquet, cut = stimrig.save(stimrig.read(good), tmp_path / "good.parquet"), tmp_path / "cut.parquet"
    cut.write_bytes(parquet.read_bytes()[:-9])

    async def work(pool: Pool) -> tuple[dict[str, Any], dict[str, Any]]:
        for path, says in ((cut, "damaged Parquet"), (bad, "torque_nm")):
            await refused(pool.submit("fit", data=str(path)), says)
        fitted = await pool.submit("fit", data=str(parquet)).result
        return fitted, await pool.submit("curves", data=str(good), model_json=fitted["json"]).result

    fitted, curves = with_pool(work, Worker)
    assert json.loads(fitted["json"])["model_id"] == fitted["model"]["model_id"]
    assert abs(fitted["model"]["linear"]["time_constant_s"] - 0.5284) < 0.05
    left = [a - b for a, b in zip(curves["torque_nm"], curves["predicted_torque_nm"], strict=True)]
    assert math.sqrt(sum(value**2 for value in left) / len(left)) < 0.1
    assert [part["name"] for part in curves["segments"]] == ["rest", "prbs", "rest", "ramp", "rest", "validate"]
    assert abs(curves["step_response"]["response"][-1] - 1) < 0.05

"""identify in worker processes: cancellable, urgent first, a death is no catastrophe, and a real fit."""

from __future__ import annotations

import asyncio
import json
import math
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import stimrig
from stimrig.api.errors import ApiError
from stimrig.api.workers import process
from stimrig.api.workers.pool import WORKER, Pool
from stimrig.api.workers.process import environment
from tests.api.fake_rig import default_widths, muscle
from tests.api.stub_worker import COMMAND

pytestmark = pytest.mark.slow


def with_pool(work: Any, workers: int = 1, command: tuple[str, ...] = COMMAND) -> Any:
    async def run() -> Any:
        pool = Pool(workers, command)
        try:
            async with asyncio.timeout(120):
                return await work(pool)
        finally:
            await pool.close()

    return asyncio.run(run())


def pooled(**how: Any) -> Callable[[Callable[[Pool], Any]], Callable[[], None]]:
    """A test that is given a pool of stubs, and has its loop."""

    def decorated(test: Callable[[Pool], Any]) -> Callable[[], None]:
        return lambda: with_pool(test, **how)

    return decorated


@pooled()
async def test_a_call_is_cancelled_at_once_after_it_was_handed_to_a_worker(pool: Pool) -> None:
    """Before its process has been started, and while the process of the call before waits for work."""
    for _ in range(2):
        call = pool.submit("fit", data="x", effects=["slow"])
        pool.cancel(call)
        with pytest.raises(ApiError, match="cancelled"):
            await call.result
        assert call.state == "cancelled"
        assert (await pool.submit("effects").result)["effects"], "the worker does the next call"


@pooled()
async def test_cancelled_job_frees_its_worker(pool: Pool) -> None:
    slow = pool.submit("fit", data="x", effects=["slow"])
    while slow.progress < 0.5:
        await asyncio.sleep(0.01)
    pool.cancel(slow)
    with pytest.raises(ApiError, match="cancelled"):
        await slow.result
    assert slow.state == "cancelled"
    assert (await pool.submit("fit", data="x").result)["model"]["method"] == "maximum-likelihood"


@pooled()
async def test_queued_job_can_be_cancelled(pool: Pool) -> None:
    slow, queued = pool.submit("fit", data="x", effects=["slow"]), pool.submit("fit", data="x")
    await asyncio.sleep(0.05)
    pool.cancel(queued)
    with pytest.raises(ApiError, match="cancelled"):
        await queued.result
    assert slow.state == "running"


def test_a_call_that_came_while_the_worker_started_is_answered_after_the_one_before() -> None:
    """As of a follower that was cancelled, and the next test's."""
    calls = "".join(json.dumps({"call": n, "verb": "effects", "arguments": {}}) + "\n" for n in (1, 2))
    process = subprocess.Popen(WORKER, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment())
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(calls)
    process.stdin.flush()
    ends = threading.Timer(100.0, process.kill)
    ends.start()
    try:
        answered = (json.loads(line) for line in process.stdout)
        assert [next(found["call"] for found in answered if "result" in found) for _ in range(2)] == [1, 2]
    finally:
        ends.cancel()
        process.kill()
        process.communicate()


@pooled()
async def test_dead_worker_is_a_problem_and_the_next_job_gets_a_new_one(pool: Pool) -> None:
    with pytest.raises(ApiError, match="died"):
        await pool.submit("fit", data="x", effects=["die"]).result
    await pool.submit("fit", data="x").result


@pytest.mark.parametrize(
    "line",
    ["[]", "{", "[" * 100_000, '{"call": 1}', '{"call": 1, "error": {}}', '{"call": 1, "error": 5}']
    + [f'{{"call": 1, "result": {result}}}' for result in ("null", "5", "[1]")]
    + [f'{{"call": 1, "text": "", "progress": {fraction}}}' for fraction in ('"far"', "NaN", "[]", "1" + "0" * 400)],
)
def test_a_worker_that_says_what_none_of_ours_says_is_ended(line: str) -> None:
    """As one that a record has taken over: nothing of it is shown to whoever asks for jobs."""
    code = f"import sys, time; sys.stdin.readline(); print({line!r}, flush=True); time.sleep(100)"

    async def work(pool: Pool) -> None:
        call = pool.submit("fit", data="x")
        with pytest.raises(ApiError, match="was ended") as caught:
            await call.result
        assert caught.value.code == "worker-died" and call.document()["progress"] == 0.0
        process = pool.workers[0].process
        assert process is not None and process.returncode is not None

    with_pool(work, command=(sys.executable, "-c", code))


@pooled(workers=2)
async def test_fit_after_a_test_goes_first_and_has_a_worker_kept_free(pool: Pool) -> None:
    blocking = [pool.submit("fit", data="x", effects=["slow"]) for _ in range(3)]
    urgent = await asyncio.wait_for(pool.submit("fit", urgent=True, data="x").result, 20)
    assert urgent["model"]
    assert sum(call.state == "running" for call in blocking) == 1


@pooled()
async def test_expected_error_names_the_place(pool: Pool) -> None:
    with pytest.raises(ApiError) as caught:
        await pool.submit("fit", data="x", effects=["bad"]).result
    assert caught.value.status == 422 and caught.value.extra["place"] == "effects"


def test_the_time_that_is_left_never_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither while nothing is heard, nor where a step takes longer than the ones before."""
    now_s = 100.0
    monkeypatch.setattr(process.time, "monotonic", lambda: now_s)

    async def left() -> list[float | None]:
        nonlocal now_s
        call, found = process.Call(1, "fit", {}, state="running", started_s=100.0), []
        for at_s, progress in ((101, 0.01), (102, 0.1), (105, None), (110, 0.2), (111, 0.5), (121, None), (130, 0.6)):
            now_s = float(at_s)
            if progress is not None:
                call.advance(progress, "")
            found.append(call.time_left_s)
        return found

    assert asyncio.run(left()) == pytest.approx([None, 18.0, 15.0, 10.0, 9.0, 0.0, 0.0])


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

    async def work(pool: Pool) -> dict[str, Any]:
        with pytest.raises(ApiError, match="damaged Parquet"):
            await pool.submit("fit", data=str(cut)).result
        assert (await pool.submit("fit", data=str(parquet)).result)["model"]["fit"]["fit_percent"] > 95
        found = await pool.submit("fit", data=str(good)).result
        curves = await pool.submit("curves", data=str(good), model_json=found["json"]).result
        with pytest.raises(ApiError, match="torque_nm"):
            await pool.submit("fit", data=str(bad)).result
        return {**found, "curves": curves}

    found = with_pool(work, command=WORKER)
    assert json.loads(found["json"])["model_id"] == found["model"]["model_id"]
    assert found["model"]["fit"]["fit_percent"] > 95
    assert abs(found["model"]["linear"]["time_constant_s"] - 0.5284) < 0.05
    curves = found["curves"]
    left = [a - b for a, b in zip(curves["torque_nm"], curves["predicted_torque_nm"], strict=True)]
    assert math.sqrt(sum(value**2 for value in left) / len(left)) < 0.1
    assert [part["name"] for part in curves["segments"]] == ["rest", "prbs", "rest", "ramp", "rest", "validate"]
    assert abs(curves["step_response"]["response"][-1] - 1) < 0.05

"""Previews in a process of their own: bounded in time, memory and number."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import pytest

from stimrig.rig.adapters import previews
from stimrig.rig.adapters.previews import Previews
from stimrig.rig.errors import BusyError
from stimrig.rig.limits import HARD_LIMITS

ROOT = Path(__file__).parents[2]
PLAN = {"test_id": "t", "participant": "P", "profile": {"current_ma": 20.0}}
REQUEST = json.dumps({"kind": "preview", "id": 3, "plan": PLAN}).encode() + b"\n"


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def test_one_that_takes_too_long_is_ended_and_the_next_is_built(monkeypatch: pytest.MonkeyPatch):
    async def run() -> None:
        asked = Previews(HARD_LIMITS, 1.0)
        await asked.warm()
        first = asked._process
        monkeypatch.setattr(previews, "MAX_BUILD_S", 0.0)
        with pytest.raises(BusyError, match="not built within"):
            await asked.reply(REQUEST)
        assert first is not None
        assert first.returncode is not None
        monkeypatch.setattr(previews, "MAX_BUILD_S", 60.0)
        reply = json.loads(await asked.reply(REQUEST))
        assert (reply["id"], reply["ok"], reply["body"]["duration_s"]) == (3, True, pytest.approx(38.7))
        await asked.close()

    asyncio.run(run())


def test_who_would_wait_for_too_long_is_refused_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(previews, "MAX_BUILD_S", 60.0)

    async def run() -> None:
        asked = Previews(HARD_LIMITS, 1.0)
        found = await asyncio.gather(*(asked.reply(REQUEST) for _ in range(40)), return_exceptions=True)
        assert [isinstance(one, bytes) for one in found[: previews.MAX_WAITING]] == [True] * previews.MAX_WAITING
        assert all(isinstance(one, BusyError) for one in found[previews.MAX_WAITING :])
        assert json.loads(await asked.reply(REQUEST))["ok"]
        await asked.close()

    asyncio.run(run())


def test_memory_is_bounded():
    code = "import stimrig.rig.builder as b; b._modest(); bytearray(2 << 30)"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert "MemoryError" in ended.stderr


def test_what_is_wrong_is_told_and_the_builder_lives_on():
    wrong = [b"{}", b"[[", b'{"kind": "preview", "id": 9, "plan": {"test_id": 5}}', b"\xff\xfe"]
    too_long = {**PLAN, "segments": [{"name": "x", "sequence": "prbs", "settings": {"chips": 100_000}}]}
    wrong.append(json.dumps({"kind": "preview", "id": 10, "plan": too_long}).encode())

    async def run() -> None:
        asked = Previews(HARD_LIMITS, 1.0)
        process = None
        for line in wrong:
            reply = json.loads(await asked.reply(line + b"\n"))
            assert not reply["ok"]
            assert reply["problem"]["code"] in ("bad-plan", "refused")
            process = process or asked._process
        assert asked._process is process
        assert json.loads(await asked.reply(REQUEST))["ok"]
        await asked.close()

    asyncio.run(run())


def test_a_range_is_judged_by_the_calibration_of_the_moment():
    asks = {"profile": {"angle_range_rad": [0.2, 2.0], "angle_set_at_utc": "first"}, "kind": "moving"}
    plan = {**PLAN, **asks, "angle": {"range_rad": [0.2, 2.0], "still_s": 2.0}}
    line = json.dumps({"kind": "preview", "id": 1, "plan": plan}).encode() + b"\n"

    async def run() -> None:
        asked = Previews(HARD_LIMITS, 1.0)
        for now, fine in (("first", True), ("second", False), (None, False), ("first", True)):
            reply = json.loads(await asked.reply(line, now))
            assert reply["ok"] is fine, reply
            assert fine or "say the range again" in reply["problem"]["detail"]
        await asked.close()

    asyncio.run(run())

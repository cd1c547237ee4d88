"""The fault campaign's book-keeping: nothing is lost when it is cut off, and its table leaves other people's words."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from rig import limits, plan
from rig.messages import Profile, SegmentPlan, TestPlan
from tests.harness.campaign import command
from tests.harness.campaign.cases import CASES, PHASES, WINDOW_S, plan_of
from tests.harness.campaign.command import BEGIN, DOCUMENT, END, write_between
from tests.harness.campaign.judge import Verdict, judge_times
from tests.harness.campaign.log import Log
from tests.harness.campaign.runner import order
from tests.harness.campaign.table import table


def began(path: Path, **fields: float) -> Log:
    log = Log(path)
    log.begin(**{"seed": 1, "speed": 1.0, "workers": 2, **fields})
    return log


def test_a_campaign_that_was_cut_off_goes_on(tmp_path: Path):
    path, jobs = tmp_path / "out" / "f.jsonl", order(512, seed=1)
    log = began(path)
    for job in jobs[:20]:
        log.add(Verdict(*job, outcome="fault", reason="x", felt=3, kept=3))
    path.write_text(path.read_text("utf-8")[:-40], "utf-8")  # killed in mid-line
    again = Log(path)
    assert list(again.found) == jobs[:19]
    assert again.found[jobs[0]].felt == 3
    again.begin(seed=1, speed=1.0, workers=3)
    again.add(Verdict(*jobs[19], outcome="completed"))
    third = Log(path)
    assert list(third.found) == jobs[:20]
    assert len(third.sessions) == 2
    text = table(list(third.found.values()), third.conditions())
    assert "in real time, seed 1, 2 emulated rigs" in text
    with pytest.raises(SystemExit, match="--speed 1"):
        third.begin(seed=1, speed=4.0, workers=2)


def test_what_the_campaign_could_not_judge_is_made_again_and_not_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    path, document = tmp_path / "f.jsonl", tmp_path / "faults.md"
    document.write_text(f"# mine\n\n{BEGIN}\nwhat it said before\n{END}\n\nmy notes\n", "utf-8")
    asked: list[Any] = []

    class Fake:
        def __init__(self, number: int, speed: float) -> None: ...

        def inject(self, *job: Any) -> Verdict:
            asked.append(job)
            failed = "TimeoutError: once" if len(asked) == 2 else ""
            return Verdict(*job, outcome="fault", reason="told", opens=True, failed=failed)

        def close(self) -> None: ...

    monkeypatch.setattr(command.signal, "signal", lambda *_: None)
    options = ["--injections", "8", "--workers", "1", "--out", str(path)]
    for arguments, code in ((options, 1), ([*options, "--resume"], 0)):
        assert command.main(arguments, document, Fake) == code  # pyright: ignore[reportArgumentType]
        written = document.read_text("utf-8")
        assert written.startswith("# mine\n")
        assert written.endswith("\n\nmy notes\n")
        assert ("Not judged" in written) == (code == 1)
    assert len(asked) == 9
    assert asked[8] == asked[1]
    assert "8 injections" in written
    assert "what it said before" not in written
    assert "min left" in capsys.readouterr().err


def test_the_document_has_its_marks(tmp_path: Path):
    text = DOCUMENT.read_text("utf-8")
    assert text.index(BEGIN) < text.index(END)
    (tmp_path / "none.md").write_text("no marks", "utf-8")
    with pytest.raises(SystemExit, match="must be in it"):
        write_between(tmp_path / "none.md", "x")


@pytest.mark.parametrize(("fault", "phase"), list(itertools.product(CASES, PHASES[:4])))
def test_a_phase_lasts_until_its_fault_must_be_seen(fault: str, phase: str):
    for speed in (1.0, 4.0):
        segments = [SegmentPlan(**segment) for segment in plan_of(phase, CASES[fault].hidden_s, speed)]
        request = TestPlan(test_id="t", participant="P", profile=Profile(), segments=segments)
        test = plan.build(request, limits.for_plan(limits.HARD_LIMITS, request))
        lasting_s = max(s.end - s.start for s in test.segments) / 40
        assert lasting_s >= WINDOW_S + (CASES[fault].hidden_s + 0.9) * speed
        if speed == 1.0:
            assert test.duration_s < 12  # or more than 500 of them take longer than half an hour


def test_a_late_pulse_is_found_and_counted():
    for last_s, wrong in ((10.149, False), (10.151, True)):
        verdict = Verdict("cell_silent", "prbs", 1, outcome="fault", reason="stale", felt=2, kept=2, opens=True)
        judge_times(verdict, [9.0, last_s], 10.0)
        assert bool(verdict.wrong) == wrong
        assert f"know of the fault: {int(wrong)} of 1 stopped tests" in table([verdict], "")


def test_lines_of_the_log_are_json(tmp_path: Path):
    began(tmp_path / "f.jsonl").add(Verdict("no_ack", "prbs", 1))
    session, verdict = map(json.loads, (tmp_path / "f.jsonl").read_text("utf-8").splitlines())
    assert session["session"]["seed"] == 1
    assert verdict["verdict"]["fault"] == "no_ack"

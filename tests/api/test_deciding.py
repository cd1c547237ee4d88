"""The experiment that decides: asked of the rig as any test, and all recordings are then diagnosed together."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.api.cli import deciding
from stimrig.api.cli.commands import test as verb
from stimrig.api.cli.commands.diagnose import next_step
from stimrig.api.cli.errors import InputError
from stimrig.api.models import explanation
from stimrig.api.web.pages import model_view
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.responses.models import ExperimentOut
from stimrig.api.workers.verbs import experiment

DECIDING: dict[str, Any] = {
    "segments": [
        {"name": "levels-1", "sequence": "widths", "settings": {"pulse_width_us": [0.0, 120.0], "jumps": True}},
        {"name": "rest", "sequence": "rest", "settings": {"duration_s": 2}},
    ],
    "duration_s": 34.0,
    "dose": {"pulses": 1, "pulse_width_sum_us": 120.0, "torque_time_nm_s": 9.0},
    "expected_log_evidence": 3.0,
    "decides": False,
    "text": "Held random levels should teach most: 40 % of what the model is unsure of at held levels should go.",
}
MISSING = [{"effect": "fatigue", "confused_with": ["potentiation"], "next_experiment_plan": {}}]


def test_it_goes_before_the_test_between_rivals_and_the_page_shows_it() -> None:
    found = experiment(MISSING, DECIDING)
    assert found is not None and found["effect"] == "" and found["text"] == DECIDING["text"]
    ExperimentOut.model_validate(found)
    shown = explanation.tidy_experiment(found, {})
    assert shown["shown"] == ["widths", "Rest 2 s"] and shown["text"] == DECIDING["text"]
    assert "stimrig test --decide" in next_step(
        {"verdict": "unexplained_structure", "deciding_experiment": DECIDING}, ""
    )


def test_the_page_says_of_a_test_without_rivals_that_it_teaches_and_of_others_that_they_tell_apart() -> None:
    found = experiment(MISSING, DECIDING)
    assert found is not None
    card = environment.get_template("why.html").module.experiment  # pyright: ignore[reportAttributeAccessIssue]
    for rivals, said, unsaid in (([], "teaches", "tells them apart"), (["fatigue"], "tells them apart", "teaches")):
        html = card(explanation.tidy_experiment({**found, "rivals": rivals}, {}))
        assert said in html and unsaid not in html and ("Decides" in html) == bool(rivals)


def test_the_page_asks_for_it_at_the_rate_of_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    bodies: list[Any] = []

    async def ask(_context: object, _who: object, body: Any, back: str) -> str:
        bodies.append(body)
        return back

    known = {"segments": DECIDING["segments"], "pulse_rate_hz": 25.0}
    context: Any = SimpleNamespace(analyses=SimpleNamespace(known_diagnosis=lambda _: {"experiment": known}))
    row: Any = SimpleNamespace(id="M1", participant="P1")
    monkeypatch.setattr(model_view.starting, "ask", ask)
    for rate_hz in (25.0, 40.0):  # a diagnosis that was kept by an earlier version tells none
        asyncio.run(model_view.run_experiment(context, SimpleNamespace(name="B"), row))  # pyright: ignore[reportArgumentType]
        assert bodies[-1].pulse_rate_hz == rate_hz and bodies[-1].joins == "M1"
        assert [dict(one) for one in bodies[-1].segments] == DECIDING["segments"]
        known.pop("pulse_rate_hz", None)


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> list[list[Path]]:
    """The files of each record that is diagnosed; structure is left in the first one."""
    loaded: list[list[Path]] = []
    found = SimpleNamespace(to_dict=lambda: {"verdict": "nothing_missing"})
    planned = SimpleNamespace(segments=DECIDING["segments"])

    def load(data: list[Path]) -> Any:
        assert all(path.exists() for path in data)
        loaded.append(list(data))
        return SimpleNamespace(pulse_rate_hz=25.0)

    monkeypatch.setattr(deciding, "load_record", load)
    monkeypatch.setattr(deciding.identify, "diagnose", lambda *_: found, raising=False)
    monkeypatch.setattr(deciding.identify, "next_experiment", lambda _: planned, raising=False)
    return loaded


def test_the_verb_asks_for_it_and_diagnoses_all_together(
    recordings: list[list[Path]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, told, sent = tmp_path / "first.h5", [], {}
    first.write_bytes(b"first")

    def play(_rig: object, _data: object, _emulate: str, participant: str, asked: dict[str, Any]) -> dict[str, Any]:
        sent.update(asked, participant=participant)
        return {"test": {}, "model": {}, "recording": b"second"}

    monkeypatch.setattr(verb, "on_own_services", play)
    monkeypatch.setattr(verb, "say_json", told.append)
    verb.test(participant="P1", decide=[first], as_json=True)
    assert sent == {
        "participant": "P1", "kind": "next-experiment", "segments": DECIDING["segments"], "pulse_rate_hz": 25.0,
    }  # fmt: skip
    assert recordings[0] == [first] and recordings[1][0] == first and len(recordings[1]) == 2
    assert told[0]["diagnosis"]["verdict"] == "nothing_missing" and "recording" not in told[0]


def test_the_verb_plays_nothing_where_nothing_is_left(
    recordings: list[list[Path]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "first.h5").touch()
    monkeypatch.setattr(deciding.identify, "next_experiment", lambda _: None, raising=False)
    monkeypatch.setattr(verb, "on_own_services", lambda *_: pytest.fail("it played"))
    with pytest.raises(InputError, match="nothing is left to decide"):
        verb.test(decide=[tmp_path / "first.h5"])
    with pytest.raises(InputError, match="leave out --adaptive"):
        verb.test(decide=[tmp_path / "first.h5"], adaptive=True)
    assert len(recordings) == 1

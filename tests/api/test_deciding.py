"""The experiment that decides: asked of the rig as any test, and all recordings are then diagnosed together."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.api.cli import deciding
from stimrig.api.cli.commands import test as verb
from stimrig.api.cli.commands.diagnose import diagnosis_lines
from stimrig.api.cli.errors import InputError
from stimrig.api.client.errors import NotFound
from stimrig.api.errors import ApiError
from stimrig.api.jobs.verbs import experiment
from stimrig.api.models import explanation
from stimrig.api.sessions.runner import Runner
from stimrig.api.web.pages import model_view
from stimrig.api.web.responses.models import ExperimentOut
from stimrig.identify.records.record import Source

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
OWNER, FOUND = "P1", {"verdict": "unexplained_structure"}
MISSING = [{"effect": "fatigue", "confused_with": ["potentiation"], "next_experiment_plan": {}}]


def test_it_goes_before_the_test_between_rivals_and_the_page_shows_it() -> None:
    found = experiment(MISSING, DECIDING)
    assert found is not None and found["effect"] == "" and found["text"] == DECIDING["text"]
    ExperimentOut.model_validate(found)
    shown = explanation.tidy_experiment(found, {})
    assert shown["shown"] == ["Levels held at random", "Rest 2 s"] and shown["text"] == DECIDING["text"]
    left = {"verdict": "unexplained_structure", "deciding_experiment": DECIDING, "base": {}, "probability": 1.0,
            "structure": [], "noise_sd_nm": 0.05}  # fmt: skip
    said = diagnosis_lines(left)[-1]
    assert "stimrig test --decide" in said and "stimrig explain" not in said and "next experiment" in said
    gate = {"effect": "free_gate", "name": "A gate", "words": "", "left_out": ""}
    said = diagnosis_lines({**left, "free": [gate], "add": ["free_gate"]})[-1]
    assert "Add “A gate”" in said and "`stimrig explain DATA -o MODEL.json` adds" in said


def test_the_page_asks_for_it_at_the_rate_of_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    bodies: list[Any] = []

    async def ask(_context: object, _who: object, body: Any, back: str) -> str:
        bodies.append(body)
        return back

    known = {"segments": DECIDING["segments"], "pulse_rate_hz": 25.0}
    context: Any = SimpleNamespace(analyses=SimpleNamespace(known_diagnosis=lambda _: {"experiment": known}))
    row: Any = SimpleNamespace(id="M1", method="", participant="P1")
    monkeypatch.setattr(model_view.starting, "ask", ask)
    for rate_hz in (25.0, 40.0):  # a diagnosis that was kept by an earlier version tells none
        asyncio.run(model_view.run_experiment(context, SimpleNamespace(name="B"), row))  # pyright: ignore[reportArgumentType]
        assert bodies[-1].pulse_rate_hz == rate_hz and bodies[-1].joins == "M1"
        assert [one.model_dump(exclude_unset=True) for one in bodies[-1].segments] == DECIDING["segments"]
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
        source = Source(participant=OWNER, current_ma=16.0)
        return SimpleNamespace(pulse_rate_hz=25.0, sample_rate_hz=400.0, source=source)

    monkeypatch.setattr(deciding, "load_record", load)
    left = SimpleNamespace(to_dict=dict)  # of the first model nothing is open, of the last one something is
    explained = SimpleNamespace(diagnosis=found, left=left, improvement=SimpleNamespace(models=[None]))
    monkeypatch.setattr(deciding, "held_by", lambda *_: [])
    monkeypatch.setattr(deciding.identify, "explain", lambda *_: explained, raising=False)
    monkeypatch.setattr(
        deciding.identify, "next_experiment", lambda one: planned if one is left else None, raising=False
    )
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
    output = tmp_path / "second.h5"
    monkeypatch.setattr(
        deciding, "diagnose_together", lambda *_: pytest.fail("not written") if not output.exists() else FOUND
    )
    verb.test(decide=[first], output=output, as_json=True)
    assert output.read_bytes() == b"second", "written before the long work that may fail"
    assert sent == {
        "participant": OWNER, "kind": "next-experiment", "segments": DECIDING["segments"], "pulse_rate_hz": 25.0,
        "recorded_ma": 16.0,
    }  # fmt: skip
    assert recordings == [[first]] and told[0]["diagnosis"] == FOUND and "recording" not in told[0]


def test_both_are_diagnosed_together(recordings: list[list[Path]], tmp_path: Path) -> None:
    first = tmp_path / "first.h5"
    first.touch()
    found = deciding.diagnose_together([first], b"second")
    assert found["verdict"] == "nothing_missing" and found["left"]["structure"] == []
    assert recordings[0][0] == first and len(recordings[0]) == 2


@pytest.mark.parametrize(
    ("sources", "rate_hz", "participant", "said"),
    [
        ([OWNER], 400.0, "P2", "a recording of P1; --participant is P2"),
        ([""], 400.0, None, "does not say whose it is. Give --participant"),
        ([OWNER, "P2"], 400.0, None, "of several people: P1, P2"),
        ([OWNER, ""], 400.0, None, "second.csv does not say whose it is"),
        ([OWNER], 30.0, None, "joined from 50 Hz on"),
        ([OWNER], 400.0, None, "does not say with what current it was made"),
        (["", ""], 400.0, OWNER, "does not say with what current it was made"),
    ],
)
def test_nobody_is_stimulated_for_a_recording_that_is_anothers_or_cannot_be_joined(
    sources: list[str], rate_hz: float, participant: str | None, said: str, monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path, recordings: list[list[Path]],
) -> None:  # fmt: skip
    (tmp_path / "first.h5").touch()
    source = Source(parts=tuple(Source(participant=one) for one in sources))
    record = SimpleNamespace(pulse_rate_hz=25.0, sample_rate_hz=rate_hz, source=source)
    monkeypatch.setattr(deciding, "load_record", lambda _: record)
    monkeypatch.setattr(verb, "on_own_services", lambda *_: pytest.fail("it played"))
    with pytest.raises(InputError, match=said):
        verb.test(participant=participant, decide=[tmp_path / "first.h5", tmp_path / "second.csv"])


@pytest.mark.parametrize(
    ("recorded_ma", "known", "said"),
    [
        (16.0, True, None), (None, True, None),
        (20.0, True, "made with 20 mA, P1 is now stimulated with 16 mA"),
        (16.0, False, "no participant P1: their limits are not known here"),
    ],
)  # fmt: skip
def test_nobody_is_made_anew_or_stimulated_with_another_current_for_a_recording(
    recorded_ma: float | None, known: bool, said: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def participant(_code: str) -> dict[str, Any]:
        if not known:
            raise NotFound("GET", "not found")
        return {"profile": {"current_ma": 16.0}}

    client = SimpleNamespace(participant=participant, model_file=str, recording=bytes)
    started: list[dict[str, Any]] = []
    monkeypatch.setattr(verb, "Client", lambda *_: nullcontext(client))
    monkeypatch.setattr(
        verb, "run_test", lambda *_, **more: started.append(more) or {"model_id": "", "recording_id": 0}
    )
    with pytest.raises(InputError, match=said) if said else nullcontext():
        verb.through("url", "token", OWNER, request={"kind": "next-experiment", "recorded_ma": recorded_ma})
    assert started == ([] if said else [{"kind": "next-experiment"}])


def test_recordings_of_two_currents_are_not_continued(
    recordings: list[list[Path]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    parts = tuple(Source(participant=OWNER, current_ma=one) for one in (16.0, 20.0))
    record = SimpleNamespace(pulse_rate_hz=25.0, sample_rate_hz=400.0, source=Source(parts=parts))
    monkeypatch.setattr(deciding, "load_record", lambda _: record)
    with pytest.raises(InputError, match="made with 16 mA and 20 mA"):
        deciding.plan_experiment([tmp_path / "first.h5", tmp_path / "second.h5"], None)


def test_where_the_recording_cannot_be_written_is_said_before_anything_is_played(
    recordings: list[list[Path]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(verb, "on_own_services", lambda *_: pytest.fail("it played"))
    (tmp_path / "file").touch()
    for output in (tmp_path, tmp_path / "file" / "second.h5"):
        with pytest.raises(InputError, match="in a folder that can be written"):
            verb.test(decide=[tmp_path / "first.h5"], output=output)
    assert recordings == []


SITE = ("right", "biceps brachii", None)


@pytest.mark.parametrize(
    ("measured_at", "kind"),
    [
        ((SITE, 20.0), None), ((None, None), None), ((SITE, None), None),
        ((("left", *SITE[1:]), 20.0), "other-site"), (((None, None, None), 20.0), "other-site"),
        ((SITE, 16.0), "other-current"),
    ],
)  # fmt: skip
def test_what_cannot_be_joined_is_refused_before_it_is_played(measured_at: Any, kind: str | None) -> None:
    versions = SimpleNamespace(
        get=lambda _: SimpleNamespace(id="M1", method="", participant="P1"), measured_at=lambda _: measured_at
    )
    participant: Any = SimpleNamespace(code="P1", side=SITE[0], muscle=SITE[1], placement=SITE[2])
    plan: Any = SimpleNamespace(profile=SimpleNamespace(current_ma=20.0))
    check = partial(Runner._check_joins, SimpleNamespace(versions=versions), "M1", participant, plan)  # pyright: ignore
    if kind is None:
        check()
        return
    with pytest.raises(ApiError) as refused:
        check()
    assert refused.value.status == 409 and refused.value.code == kind


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

"""`stimrig test`: the experiment that decides is asked of the rig as any test, and nobody else is stimulated for it."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.api.cli import deciding
from stimrig.api.cli.commands import test as verb
from stimrig.api.cli.errors import InputError
from stimrig.api.client.errors import NotFound, ServiceError
from stimrig.api.errors import ApiError
from stimrig.api.jobs.verbs import experiment
from stimrig.api.models import explanation
from stimrig.api.sessions.runner import Runner
from stimrig.api.web.pages import starting
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
OWNER = "P1"


def test_it_goes_before_the_test_between_rivals_and_is_shown() -> None:
    found = experiment([{"effect": "fatigue", "confused_with": ["potentiation"], "next_experiment_plan": {}}], DECIDING)
    assert found is not None and found["effect"] == "" and found["text"] == DECIDING["text"]
    ExperimentOut.model_validate(found)
    assert explanation.tidy_experiment(found)["shown"] == ["Levels held at random", "Rest 2 s"]


def test_the_page_asks_for_it_at_the_rate_of_the_recording() -> None:
    known, row = {"segments": DECIDING["segments"], "pulse_rate_hz": 25.0}, SimpleNamespace(id="M1", participant=OWNER)
    analyses, versions = (
        SimpleNamespace(known_diagnosis=lambda _: {"experiment": known}),
        SimpleNamespace(get=lambda _: row),
    )
    context: Any = SimpleNamespace(analyses=analyses, versions=versions)
    assert starting.fields_of_kind(context, OWNER, "next-experiment", None, None, "M1") == {"joins": "M1", **known}


class Recordings:
    """Files that are read, with the sources that they name; what is played is kept, and answered by a recording."""

    def __init__(self) -> None:
        self.loaded: list[list[Path]] = []
        self.played: list[dict[str, Any]] = []
        self.source, self.rate_hz = Source(participant=OWNER, current_ma=16.0), 400.0
        self.open = True

    def load(self, data: list[Path]) -> Any:
        self.loaded.append(list(data))
        return SimpleNamespace(pulse_rate_hz=25.0, sample_rate_hz=self.rate_hz, source=self.source)

    def explain(self, *_: object) -> Any:
        found, left = SimpleNamespace(to_dict=lambda: {"verdict": "nothing_missing"}), SimpleNamespace(to_dict=dict)
        return SimpleNamespace(diagnosis=found, left=left, improvement=SimpleNamespace(models=[None]))

    def next_experiment(self, diagnosis: Any) -> Any:
        """Of the first model nothing is open, of the last one something is."""
        return SimpleNamespace(segments=DECIDING["segments"]) if self.open and diagnosis.to_dict is dict else None

    def play(self, _rig: object, _data: object, _emulate: str, participant: str, request: Any) -> dict[str, Any]:
        self.played.append({"participant": participant, **request})
        return {"test": {}, "model": {}, "recording": b"second"}


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> Recordings:
    made = Recordings()
    monkeypatch.setattr(deciding, "load_record", made.load)
    monkeypatch.setattr(deciding, "held_by", lambda *_: [])
    monkeypatch.setattr(verb, "on_own_services", made.play)
    for name in ("explain", "next_experiment"):
        monkeypatch.setattr(deciding.identify, name, getattr(made, name), raising=False)
    return made


def test_the_verb_asks_for_it_and_diagnoses_both_together(
    recordings: Recordings, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, output, told, diagnose = tmp_path / "first.h5", tmp_path / "second.h5", [], deciding.diagnose_together
    monkeypatch.setattr(verb, "say_json", told.append)

    def diagnose_together(*given: Any) -> Any:
        assert output.read_bytes() == b"second", "written before the long work that may fail"
        return diagnose(*given)

    monkeypatch.setattr(deciding, "diagnose_together", diagnose_together)
    verb.test(decide=[first], output=output, as_json=True)
    assert recordings.played == [
        {"participant": OWNER, "kind": "next-experiment", "segments": DECIDING["segments"], "pulse_rate_hz": 25.0,
         "recorded_ma": 16.0}
    ]  # fmt: skip
    assert recordings.loaded[0] == [first] and recordings.loaded[1][0] == first and len(recordings.loaded[1]) == 2
    assert told[0]["diagnosis"]["verdict"] == "nothing_missing" and told[0]["diagnosis"]["left"]["structure"] == []
    assert "recording" not in told[0]


@pytest.mark.parametrize(
    ("sources", "rate_hz", "options", "said"),
    [
        ([OWNER], 400.0, {"participant": "P2"}, "a recording of P1; --participant is P2"),
        ([""], 400.0, {}, "does not say whose it is. Give --participant"),
        ([OWNER, "P2"], 400.0, {}, "of several people: P1, P2"),
        ([OWNER, ""], 400.0, {}, "second.csv does not say whose it is"),
        ([OWNER], 30.0, {}, "joined from 50 Hz on"),
        ([OWNER], 400.0, {}, "does not say with what current it was made"),
        (["", ""], 400.0, {"participant": OWNER}, "does not say with what current it was made"),
        ([(OWNER, 16.0), (OWNER, 20.0)], 400.0, {}, "made with 16 mA and 20 mA"),
        ([(OWNER, 16.0)], 400.0, {}, "nothing is left to decide"),
        ([(OWNER, 16.0)], 400.0, {"adaptive": True}, "leave out --adaptive"),
        ([(OWNER, 16.0)], 400.0, {"output": Path("/dev/null/second.h5")}, "in a folder that can be written"),
        ([(OWNER, 16.0)], 400.0, {"output": Path("/")}, "in a folder that can be written"),
    ],
)
def test_nobody_is_stimulated_where_it_is_not_theirs_cannot_be_joined_or_decides_nothing(
    sources: list[Any], rate_hz: float, options: dict[str, Any], said: str, tmp_path: Path, recordings: Recordings
) -> None:
    recordings.open, recordings.rate_hz = False, rate_hz
    named = [source if isinstance(source, tuple) else (source, None) for source in sources]
    recordings.source = Source(parts=tuple(Source(participant=who, current_ma=ma) for who, ma in named))
    with pytest.raises(InputError, match=said):
        verb.test(decide=[tmp_path / "first.h5", tmp_path / "second.csv"], **options)
    assert recordings.played == []


class Answers:
    """Stands for a client of the service."""

    def __init__(self, known: bool = True, fails: bool = False) -> None:
        self.known, self.fails = known, fails
        self.improved: list[str] = []

    def participant(self, _code: str) -> dict[str, Any]:
        if not self.known:
            raise NotFound("GET", "not found")
        return {"profile": {"current_ma": 16.0}}

    def improve(self, model_id: str, _progress: object) -> dict[str, Any]:
        self.improved.append(model_id)
        if self.fails:
            raise ServiceError("", "failed")
        return {"id": "best"}

    model_file, recording = staticmethod(str), staticmethod(bytes)


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
    started: list[dict[str, Any]] = []
    monkeypatch.setattr(verb, "Client", lambda *_: nullcontext(Answers(known)))
    monkeypatch.setattr(
        verb, "run_test", lambda *_, **more: started.append(more) or {"model_id": "", "recording_id": 0}
    )
    with pytest.raises(InputError, match=said) if said else nullcontext():
        verb.through("url", "token", OWNER, request={"kind": "next-experiment", "recorded_ma": recorded_ma})
    assert started == ([] if said else [{"kind": "next-experiment"}])


@pytest.mark.parametrize(
    ("problem", "fails", "model"), [("", False, "plain"), ("misfit", False, "best"), ("misfit", True, "plain")]
)
def test_where_an_adaptive_tests_structure_does_not_fit_the_best_model_is_given(
    problem: str, fails: bool, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = Answers(fails=fails)
    document = {"model_id": "plain", "recording_id": 0, "adaptive": {"problem": problem}}
    monkeypatch.setattr(verb, "Client", lambda *_: nullcontext(service))
    monkeypatch.setattr(verb, "run_test", lambda *_, **__: document)
    assert verb.through("url", "token", "P1")["model"] == model
    assert service.improved == (["plain"] if problem else [])


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
    with pytest.raises(ApiError) if kind else nullcontext() as refused:
        check()
    assert kind is None or (refused and (refused.value.status, refused.value.code) == (409, kind))

"""`stimrig test`: the experiment that decides is asked of the rig as any test, and nobody else is stimulated for it."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig import identify
from stimrig.api.cli import deciding
from stimrig.api.cli.commands import diagnose, explain
from stimrig.api.cli.commands import test as verb
from stimrig.api.cli.errors import InputError
from stimrig.api.client.errors import NotFound, ServiceError
from stimrig.api.errors import ApiError
from stimrig.api.jobs.verbs import experiment
from stimrig.api.models import explanation
from stimrig.api.models.registry import Versions
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
    assert explanation.tidy_experiment(found)["shown"] == ["Random levels", "Rest 2 s"]


def test_the_page_asks_for_it_at_the_rate_of_the_recording() -> None:
    known, row = {"segments": DECIDING["segments"], "pulse_rate_hz": 25.0}, SimpleNamespace(id="M1", participant=OWNER)
    analyses, versions = (
        SimpleNamespace(known_diagnosis=lambda _: {"experiment": known}),
        SimpleNamespace(get=lambda _: row),
    )
    context: Any = SimpleNamespace(analyses=analyses, versions=versions)
    assert starting.fields_of_kind(context, OWNER, "next-experiment", None, None, "M1") == {"joins": "M1", **known}


class Rig:
    """Files that are read, with the sources that they name; and a service: what is played is kept."""

    def __init__(self) -> None:
        self.loaded: list[list[Path]] = []
        self.played: list[dict[str, Any]] = []
        self.improved: list[str] = []
        self.source, self.rate_hz, self.open = Source(participant=OWNER, current_ma=16.0), 400.0, True
        self.known, self.fails, self.adaptive = True, False, {}

    def load(self, data: list[Path]) -> Any:
        self.loaded.append(list(data))
        return SimpleNamespace(pulse_rate_hz=25.0, sample_rate_hz=self.rate_hz, source=self.source)

    def explain(self, *_: object) -> Any:
        found, left = SimpleNamespace(to_dict=lambda: {"verdict": "nothing_missing"}), SimpleNamespace(to_dict=dict)
        return SimpleNamespace(diagnosis=found, left=left, improvement=SimpleNamespace(models=[None]))

    def next_experiment(self, diagnosis: Any) -> Any:
        """Of the first model nothing is open, of the last one something is."""
        return SimpleNamespace(segments=DECIDING["segments"]) if self.open and diagnosis.to_dict is dict else None

    def run_test(self, _client: Any, participant: str, *_: Any, **request: Any) -> dict[str, Any]:
        self.played.append({"participant": participant, **request})
        return {"model_id": "plain", "recording_id": "r1", "adaptive": self.adaptive}

    def participant(self, _code: str) -> dict[str, Any]:
        if not self.known:
            raise NotFound("GET", "not found")
        return {"profile": {"current_ma": 16.0}}

    def improve(self, model_id: str, _progress: object) -> dict[str, Any]:
        self.improved.append(model_id)
        if self.fails:
            raise ServiceError("", "failed")
        return {"id": "best"}

    def model_file(self, model_id: str) -> str:
        return model_id

    def recording(self, _recording_id: str) -> bytes:
        return b"second"


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    made = Rig()
    monkeypatch.setattr(deciding, "load_record", made.load)
    monkeypatch.setattr(deciding, "held_by", lambda *_: [])
    monkeypatch.setattr(verb, "service", lambda *_: nullcontext((made, list)))
    monkeypatch.setattr(verb, "run_test", made.run_test)
    monkeypatch.setattr(verb, "report_test", str)
    for name in ("explain", "next_experiment"):
        monkeypatch.setattr(deciding.identify, name, getattr(made, name), raising=False)
    return made


def test_the_verb_asks_for_it_and_diagnoses_both_together(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, output, diagnose = tmp_path / "first.h5", tmp_path / "second.h5", deciding.diagnose_together

    def diagnose_together(*given: Any) -> Any:
        assert output.read_bytes() == b"second", "written before the long work that may fail"
        return diagnose(*given)

    monkeypatch.setattr(deciding, "diagnose_together", diagnose_together)
    verb.test(decide=[first], output=output, as_json=True)
    assert rig.played == [
        {"participant": OWNER, "kind": "next-experiment", "segments": DECIDING["segments"], "pulse_rate_hz": 25.0}
    ]
    assert rig.loaded[0] == [first] and rig.loaded[1][0] == first and len(rig.loaded[1]) == 2
    told = json.loads(capsys.readouterr().out)
    assert told["diagnosis"]["verdict"] == "nothing_missing" and told["diagnosis"]["left"]["structure"] == []
    assert "recording" not in told


@pytest.mark.parametrize(
    ("sources", "more", "options", "said"),
    [
        ([(OWNER, 16.0)], {}, {"participant": "P2"}, "of several people: P1, P2"),
        ([("", 16.0)], {}, {}, "does not say whose it is. Give --participant"),
        ([(OWNER, 16.0), ("P2", 16.0)], {}, {}, "of several people: P1, P2"),
        ([(OWNER, 16.0), ("", 16.0)], {}, {}, "second.csv does not say whose it is"),
        ([(OWNER, 16.0)], {"rate_hz": 30.0}, {}, "joined from 50 Hz on"),
        ([(OWNER, None)], {}, {}, "does not say with what current it was made"),
        ([("", None)] * 2, {}, {"participant": OWNER}, "first.h5 does not say with what current it was made"),
        ([(OWNER, 16.0), (OWNER, 20.0)], {}, {}, "made with 16 mA and 20 mA"),
        ([(OWNER, 16.0)], {"open": False}, {}, "nothing is left to decide"),
        ([(OWNER, 16.0)], {}, {"adaptive": True}, "three kinds of test"),
        ([(OWNER, 16.0)], {}, {"output": Path("/dev/null/second.h5")}, "/dev/null"),
        ([(OWNER, 16.0)], {}, {"output": Path("/")}, "in a folder that can be written"),
        ([(OWNER, 20.0)], {}, {}, "made with 20 mA, P1 is now stimulated with 16 mA"),
        ([(OWNER, 16.0)], {"known": False}, {}, "no participant P1: their limits are not known here"),
    ],
)
def test_nobody_is_stimulated_where_it_is_not_theirs_cannot_be_joined_or_decides_nothing(
    sources: list[Any], more: dict[str, Any], options: dict[str, Any], said: str, tmp_path: Path, rig: Rig
) -> None:
    vars(rig).update(more)
    rig.source = Source(parts=tuple(Source(participant=who, current_ma=ma) for who, ma in sources))
    with pytest.raises((InputError, OSError), match=said):
        verb.test(decide=[tmp_path / "first.h5", tmp_path / "second.csv"], **options)
    assert rig.played == []


@pytest.mark.parametrize(
    ("problem", "fails", "model"), [("", False, "plain"), ("misfit", False, "best"), ("misfit", True, "plain")]
)
def test_where_an_adaptive_tests_structure_does_not_fit_the_best_model_is_given(
    problem: str, fails: bool, model: str, rig: Rig
) -> None:
    rig.adaptive, rig.fails = {"problem": problem}, fails
    client: Any = rig
    assert verb.play(client, "P1", {})["model"] == model
    assert rig.improved == (["plain"] if problem else [])


@pytest.mark.parametrize("model", [None, Path("old one.json")])
@pytest.mark.parametrize("output", [None, Path("/dev/null")])
def test_the_commands_that_follow_begin_with_the_model_that_was_examined(
    model: Path | None, output: Path | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    open_: Any = {"add": ["fatigue"], "deciding_experiment": DECIDING, "to_dict": dict}
    left = SimpleNamespace(conclusion=SimpleNamespace(kind="missing"), **open_)
    explained = SimpleNamespace(left=left, to_dict=dict, improvement=SimpleNamespace(models=[""]))
    given = "--model 'old one.json' " if model else ""
    assert "adds them, and" in diagnose.add_command(SimpleNamespace(add=["fatigue", "tremor"]), model)[0]
    for module in (diagnose, explain):
        monkeypatch.setattr(module, "load_structure", lambda *_: (None, None, []))
    monkeypatch.setattr(identify, "diagnose", lambda *_: left)
    monkeypatch.setattr(identify, "explain", lambda *_: explained)
    diagnose.diagnose([], model)
    printed = capsys.readouterr().out
    assert f"`stimrig explain {given}DATA -o NEW.json` adds it" in printed
    assert ("the plain structure asks" in printed) == (model is not None)
    explain.explain([], model, output=output)
    last = "--model /dev/null DATA -o NEW.json` adds it" if output else f"{given}DATA -o NEW.json` writes the last"
    printed = capsys.readouterr().out
    assert f"`stimrig explain {last}" in printed and ("the plain structure asks" in printed) == (model is not None)
    left.conclusion.kind = "nothing"
    diagnose.diagnose([], model)
    writes = f"improve {given}" if model else "fit "
    assert f"`stimrig {writes}DATA -o NEW.json` writes this model." in capsys.readouterr().out


SITE = ("right", "biceps brachii", None)


@pytest.mark.parametrize(
    ("measured_at", "kind"),
    [
        ((SITE, 20.0), None), ((None, 20.0), None),
        ((None, None), "unknown-current"), ((SITE, None), "unknown-current"),
        ((("left", *SITE[1:]), 20.0), "other-site"), (((None, None, None), 20.0), "other-site"),
        ((SITE, 16.0), "other-current"),
    ],
)  # fmt: skip
def test_what_cannot_be_joined_is_refused_before_it_is_played(measured_at: Any, kind: str | None) -> None:
    model = SimpleNamespace(id="M1", method="", participant="P1", recording_id="R1")
    versions: Any = SimpleNamespace(get=lambda _: model, measured_at=lambda _: measured_at)
    versions.why_not_joined = partial(Versions.why_not_joined, versions)
    participant: Any = SimpleNamespace(code="P1", side=SITE[0], muscle=SITE[1], placement=SITE[2])
    plan: Any = SimpleNamespace(profile=SimpleNamespace(current_ma=20.0))
    check = partial(Runner._check_joins, SimpleNamespace(versions=versions), "M1", participant, plan)
    with pytest.raises(ApiError) if kind else nullcontext() as refused:
        check()
    assert kind is None or (refused and (refused.value.status, refused.value.code) == (409, kind))

"""Every verb of the command line has its function: the table of docs/python.md is true, and each row of it runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

import stimrig
from stimrig.api.cli import main
from stimrig.errors import BadRequest
from stimrig.identify import paper
from tests.api.test_jobs import made_up_csv
from tests.harness import few_effects
from tests.stimrig.verbs_table import COMMAND_ONLY, PAGE, function_of, page, verbs

EFFECTS = ("threshold_drift",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record, its model and a torque that is wanted."""
    folder = tmp_path_factory.mktemp("verbs")
    model = stimrig.fit(stimrig.read(made_up_csv(folder / "record.csv")))
    stimrig.save(model, folder / "MODEL.json")
    (folder / "torque.csv").write_text("time_s,torque_nm\n0,0\n1,1\n2,2\n")
    return folder


@pytest.fixture(scope="module")
def record(folder: Path) -> stimrig.Record:
    return stimrig.read(folder / "record.csv")


@pytest.fixture(scope="module")
def model(folder: Path) -> stimrig.Model:
    return stimrig.Model.from_json((folder / "MODEL.json").read_text())


def test_the_tables_of_the_page_are_those_of_the_code() -> None:
    text = PAGE.read_text("utf-8")
    assert page(text) == text, "python -m tests.stimrig.verbs_table"
    assert all(f"`{verb}`" in text for verb in verbs()) and "`approve`" in text
    assert page(text.replace("| `approve` |", "| `aprove` |")) == text, "it would be noticed"


# ---- a verb and its function: one record, the same answer


SAME: dict[str, tuple[str, Callable[[Any, Any, Path], Any]]] = {
    "fit": ("{0}/record.csv", lambda record, _model, _at: stimrig.fit(record)),
    "compare": ("{0}/MODEL.json {0}/record.csv", lambda record, model, _at: stimrig.compare(model, record)),
    "explain": ("{0}/record.csv", lambda record, _model, _at: stimrig.explain(record)),
    "invert": ("{0}/MODEL.json {0}/torque.csv -o {1}/widths.csv",
               lambda _record, model, at: stimrig.invert(model, at / "torque.csv")),
    "table1": ("--trials 1", lambda *_: stimrig.table1(1)),
}  # fmt: skip
DRAWN = ("model_id", "created")
"""What no two fits have in common."""


@pytest.mark.parametrize("verb", SAME)
def test_a_function_gives_what_the_verb_prints(
    verb: str, folder: Path, record: Any, model: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    words, function = SAME[verb]
    monkeypatch.setattr(paper.table1, "__defaults__", (100, None, paper.NOISE_NM[:1]))  # one noise level
    with few_effects.only(*EFFECTS):
        assert main.run([verb, *words.format(folder, tmp_path).split(), "--json"]) == 0
        found = function(record, model, folder)
    printed, given = json.loads(capsys.readouterr().out), json.loads(json.dumps(found.to_dict()))
    assert set(printed) - set(given) <= {"structure", "output"}, "which say what the verb was given"
    assert set(given) - set(printed) <= {"models"}
    for key in set(given) & set(printed) - set(DRAWN):
        assert without_names(given[key]) == without_names(printed[key]), key
    assert 2 <= len(str(found).splitlines()) <= 20
    assert found._repr_html_().startswith("<table>") and repr(found).startswith("<")


def without_names(value: Any) -> Any:
    """A value without what is drawn for each model."""
    if isinstance(value, dict):
        return {key: without_names(one) for key, one in value.items() if key not in DRAWN}
    return [without_names(one) for one in value] if isinstance(value, list) else value


# ---- the rest of the verbs


def predicts(at: Path, _new: Path) -> None:
    record, model = stimrig.read(at / "record.csv"), stimrig.Model.from_json((at / "MODEL.json").read_text())
    assert main.run(["predict", str(at / "MODEL.json"), str(at / "record.csv"), "-o", str(_new / "p.csv")]) == 0
    rows = (_new / "p.csv").read_text().splitlines()[1:]
    assert [float(row.split(",")[2]) for row in rows] == pytest.approx(list(stimrig.predict(model, record)), abs=1e-6)


def emulates(_at: Path, new: Path) -> None:
    """What it starts: a rig without devices, whatever the environment names. tests/api/test_launcher.py starts it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STIMRIG_RIG_FILE", "/a/rig/that/has/devices.toml")
        patch.setattr("stimrig.api.cli.supervisor.Services", services := MagicMock())
        services.return_value.__enter__.return_value.url = "http://rig.test"
        with stimrig.emulate("--patient changing", data=new) as client:
            assert client.http.base_url.host == "rig.test" and not services.return_value.__exit__.called
    settings, options, _token = services.call_args.args
    assert (settings.data_dir, settings.rig_file, options) == (new, None, ["--patient", "changing"])
    assert services.return_value.__exit__.called


def lists_effects(*_: Path) -> None:
    rows = stimrig.effects()
    assert rows and all(row["equation"] and row["source"] for row in rows)


def gives_a_schema(*_: Path) -> None:
    assert stimrig.schema("invert")["properties"]["pulse_width_us"]["description"]


REST: dict[str, Callable[[Path, Path], Any]] = {
    "predict": predicts,
    "emulate": emulates,
    "effects": lists_effects,
    "schema": gives_a_schema,
}
ELSEWHERE = ("test", "cohort fit", "cohort diagnose", "cohort improve", "diagnose", "improve")
"""Run by the blocks of docs/python.md (tests/api/test_readme.py), as the parts of `explain`, or by tests/api/cohort."""


@pytest.mark.slow
@pytest.mark.parametrize("verb", REST)
def test_the_function_of_each_other_verb_runs(verb: str, folder: Path, tmp_path: Path) -> None:
    REST[verb](folder, tmp_path)


def test_no_verb_lacks_its_function_or_its_reason_and_its_test() -> None:
    assert set(verbs()) - set(COMMAND_ONLY) == {*SAME, *REST, *ELSEWHERE}
    assert all(callable(function_of(verb)[1]) for verb in set(verbs()) - set(COMMAND_ONLY))


# ---- what has no verb of its own: files, joined records, trials


def test_what_is_saved_is_read_again(folder: Path, record: Any, model: Any, tmp_path: Path) -> None:
    again = stimrig.Model.from_json(stimrig.save(model, tmp_path / "M.json").read_text())
    assert again.to_dict() == model.to_dict()
    kept = stimrig.read(stimrig.save(record, tmp_path / "record.csv"))
    assert list(kept.torque_nm) == list(record.torque_nm) and list(kept.segment) == list(record.segment)
    plan = stimrig.invert(model, [0.0, 1.0, 2.0], time_s=[0.0, 1.0, 2.0])
    assert stimrig.save(plan, tmp_path / "w.csv").read_text().startswith("time_s,pulse_width_us,")
    assert list(plan.pulse_width_us) == list(stimrig.invert(model, folder / "torque.csv").pulse_width_us)
    for what, name in ((record, "r.json"), (model, "m.csv"), (plan, "p.html"), (model, "without_record.html")):
        with pytest.raises(BadRequest):
            stimrig.save(what, tmp_path / name)


def test_a_model_is_tracked_over_trials(record: Any, model: Any) -> None:
    weaker = record.with_torque(0.9 * record.torque_nm)
    tracked = stimrig.track(model, [record, weaker, weaker])
    gains = [trial["now"]["gain"]["value"] for trial in tracked.to_dict()["trials"]]
    assert gains[0] == pytest.approx(1.0, abs=0.02) and gains[2] < 0.97
    assert str(tracked).count("trial ") >= 3 and "gain" in tracked._repr_html_()
    assert max(tracked.model.predict(record)) < 0.97 * max(model.predict(record))
    assert tracked.approved is model
    with pytest.raises(BadRequest, match="no trial"):
        stimrig.track(model, [])

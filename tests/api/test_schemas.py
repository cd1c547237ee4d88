"""What each verb prints with `--json` holds to its published schema, key by key; the schemas are served and printed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
import pytest

from stimrig.api import schemas
from stimrig.api.cli import main
from stimrig.api.cli.commands.test import play
from stimrig.api.client.rest import Client
from stimrig.api.store import Store
from stimrig.identify import paper
from stimrig.identify.json_text import json_value
from stimrig.identify.model import SCHEMA_VERSION
from stimrig.identify.problem.joint_surface import joint_tables
from tests.api.conftest import REAL, TOKEN, serving

pytestmark = pytest.mark.slow

ALL = {name: schemas.load(name) for name in schemas.NAMES}
REGISTRY = jsonschema_rs.Registry([(schema["$id"], schema) for schema in ALL.values()])


def unmet(name: str, document: dict[str, Any]) -> list[str]:
    """What a document lacks of its schema, and which of its keys at the top the schema does not know."""
    check = jsonschema_rs.validator_for(schemas.load(name), registry=REGISTRY)
    unknown = sorted(set(document) - set(schemas.load(name)["properties"]))
    return [f"{list(error.instance_path)}: {error.message[:200]}" for error in check.iter_errors(document)] + unknown


@pytest.mark.parametrize("verb", ["predict", "compare", "invert", "effects", "doctor", "audit"])
def test_a_verbs_json_holds_to_its_schema(verb: str, record: Path, model: Path, capsys: pytest.CaptureFixture[str]):
    folder, reference = record.parent, record.with_name("reference.csv")
    reference.write_text("time_s,torque_nm\n0,0\n1,2\n2,0\n")
    Store(f"sqlite:///{folder}/stimrig.db").close()
    words = {
        "predict": f"{model} {record} -o {folder}/out.csv", "compare": f"{model} {record}", "effects": "",
        "invert": f"{model} {reference} -o {folder}/widths.csv", "doctor": f"--data {folder}",
        "audit": f"verify --data {folder}",
    }[verb]  # fmt: skip
    capsys.readouterr()
    assert main.run([verb, *words.split(), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == "" and out.count("\n") == 1, "one object and nothing else"
    assert unmet(verb, json.loads(out)) == []


def test_g_and_h_hold_to_the_models_schema(model: Path) -> None:
    settings = {"reference_rad": 1.5, "angle_range_rad": [1.0, 2.0], "scale_nm": 5.0, "sign": 1.0}
    values = {"slope_per_rad": 0.1, "bend_per_rad2": -0.4}
    bent = {"id": "torque_angle", "form": "parabola", "parameters": values, "settings": settings}
    names = [f"torque_angle.{name}" for name in values]
    angle_rad, work = np.linspace(1.0, 2.0, 50), np.ones(50, bool)
    tables = joint_tables((bent,), names, np.eye(2) * 1e-4, angle_rad, np.full(50, 0.2), work)
    document = json.loads(model.read_text())
    whole = document | {"joint": json_value(tables)}
    assert set(whole["joint"]) == set(ALL["model"]["properties"]["joint"]["properties"])
    assert unmet("model", whole) == []
    assert unmet("model", document | {"joint": {**whole["joint"], "seen_g": [[0.5]]}}) != []


def test_what_needs_no_service_holds_to_its_schema(model: Path) -> None:
    assert unmet("fit", json.loads(model.read_text())) == []
    assert unmet("table1", paper.table1(1, noise_levels_nm=(paper.NOISE_NM[0],))) == []
    command = [sys.executable, "-m", "stimrig.hardware_sim"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulator:
        assert emulator.stdout is not None
        try:
            assert unmet("emulate", json.loads(emulator.stdout.readline())) == []
        finally:
            emulator.send_signal(signal.SIGTERM)


def test_a_tests_json_holds_to_its_schema(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, REAL) as (service, _), Client(service.url, TOKEN) as client:
        found = play(client, "P017", {})
    del found["recording"]
    assert unmet("test", found) == []
    files = dict.fromkeys(("recording", "model", "report", "logs"), "/somewhere")
    assert unmet("demo", {**found, "files": files, "seconds": 45.0}) == []


def test_each_schema_is_sound_and_named_with_its_version() -> None:
    for name, schema in ALL.items():
        jsonschema_rs.meta.validate(schema)
        assert schema["$id"].startswith(f"urn:stimrig:schema:{name}:1.")
    assert ALL["model"]["$id"].endswith(f":{SCHEMA_VERSION}")


def test_a_schema_is_printed_by_its_name_and_by_its_verb(capsys: pytest.CaptureFixture[str]) -> None:
    for asked, name in (("model", "model"), ("fit", "model"), ("diagnose", "diagnosis")):
        assert main.run(["schema", asked]) == 0
        assert json.loads(capsys.readouterr().out) == ALL[name]
    assert main.run(["schema"]) == 0
    assert capsys.readouterr().out.split() == [schema["$id"] for schema in ALL.values()]
    assert main.run(["schema", "colour"]) == 2
    assert "colour: no such schema. Give one of audit, " in capsys.readouterr().err


def test_every_verb_with_json_has_a_schema() -> None:
    told = {
        verb for verb in main.VERBS
        if "as_json" in (Path(main.commands.__path__[0]) / f"{verb}.py").read_text()
    }  # fmt: skip
    assert len(told) > 9
    assert [verb for verb in told if schemas.OF_VERB.get(verb, verb) not in schemas.NAMES] == []

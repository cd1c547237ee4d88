"""What is called on the command line: on each recording, and without one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stimrig.api.settings import Settings
from stimrig.api.web.app import create_app
from tests.frozen.answers import call, condensed, condensed_file, run, working_in
from tests.frozen.records import IN_FULL, MORE_WORDS, RECORDS
from tests.frozen.rig_records import of_kind
from tests.harness import cohort_records

METHODS = ("two-stage", "ramp-deconvolution", "separable-least-squares", "narx")
VERBS = (
    "", "fit", "predict", "compare", "diagnose", "improve", "invert", "export", "recover", "audit", "audit verify",
    "audit export", "effects", "schema", "table1", "test", "doctor", "demo", "serve", "emulate",
    "cohort", "cohort fit", "cohort diagnose", "cohort improve",
)  # fmt: skip
REFUSED = (
    "fly", "fit", "fit none.csv", "fit plain.csv --effects no_such_effect", "fit plain.csv --effects fatigue:none",
    "fit plain.csv --fit-on validate", "fit plain.csv --fit-on nowhere", "fit plain.csv --method magic",
    "fit plain.csv --method narx --effects fatigue", "fit plain.csv -o none/model.json", "fit plain.csv --map x",
    "fit plain.csv --map torque_nm=force:N", "fit plain.csv --carry plain.csv", "fit model.json", "fit plain.csv --fly",
    "predict plain.csv plain.csv -o p.csv", "predict future.json plain.csv -o p.csv",
    "predict cut.json plain.csv -o p.csv",
    "predict model.json none.csv -o p.csv", "compare model.json plain.csv --html none/c.html", "compare model.json",
    "diagnose plain.csv --model none.json", "improve plain.csv -o model.txt", "invert model.json plain.csv -o i.csv",
    "invert model.json reference.csv -o i.csv --largest-us 9000", "export cohort", "export cohort -o cohort",
    "export cohort -o b --select day", "recover none.journal", "recover plain.csv", "recover cut.journal",
    "audit verify", "audit export -o a.jsonl", "audit verify --file plain.csv", "schema nothing",
    "table1 --trials 0", "test --protocol none", "test --rig none.toml", "cohort fit",
    "cohort fit nowhere -o r.parquet",
    "cohort fit cohort -o r.parquet --select day", "cohort fit cohort -o r.parquet --workers 0",
    "serve --port 99999", "emulate --patient none", "emulate --fault none",
)  # fmt: skip
DONE = (
    "--version", "effects", "effects --json", "table1 --trials 2", "table1 --trials 1 --json",
    "fit plain.csv again.csv -o both.json --json",
    "invert model.json reference.csv -o i.csv",
    "recover T1.journal -o recovered --json", "recover cut_end.journal -o again",
    "export cohort -o parquet --format parquet --json", "export cohort -o mat --format mat --no-dates",
    "export cohort -o csv",
    "cohort fit cohort -o fit.parquet --workers 1 --json", "cohort fit cohort -o fit.parquet --workers 1",
    "cohort fit cohort -o tired.parquet --workers 1 --effects fatigue",
    "cohort diagnose cohort -o diagnosed.parquet --workers 1 --json --select participant=='P001'",
)  # fmt: skip


def of_record(name: str, folder: Path) -> dict[str, Any]:
    """The recording itself, and what fits, compares and predicts."""
    path = RECORDS[name](folder)
    data = path.name
    calls = [
        f"fit {data} -o model.json --json", f"fit {data}", f"compare model.json {data} --json",
        f"predict model.json {data} -o predicted.csv --json",
    ]  # fmt: skip
    if name in IN_FULL:
        calls += [f"fit {data} --method {method} -o {method}.json --json" for method in METHODS]
        calls += [
            f"compare model.json {data} --html compared.html", f"compare model.json {data}",
            f"fit {data} --effects fatigue -o tired.json --json", f"compare tired.json {data} --json",
            "invert model.json reference.csv -o inverted.csv --json",
        ]  # fmt: skip
    return {"recording": condensed_file(path, folder)} | _all_of(name, calls, folder)


def diagnosed(name: str, folder: Path) -> dict[str, Any]:
    """What is missing in its model; this takes longer."""
    data = RECORDS[name](folder).name
    calls = [f"diagnose {data} --json"]
    if name in IN_FULL:
        calls += [
            f"diagnose {data}", f"improve {data} -o improved.json --html improved.html --json", f"improve {data}",
            f"fit {data} --carry improved.json -o carried.json --json", f"diagnose {data} --model improved.json",
        ]  # fmt: skip
    return _all_of(name, calls, folder)


def _all_of(name: str, calls: list[str], folder: Path) -> dict[str, Any]:
    _reference(folder)
    with working_in(folder):
        return {line: call(f"{line} {MORE_WORDS.get(name, '')}") for line in calls}


def without_record(folder: Path) -> dict[str, Any]:
    """Calls that make or take their files themselves, help, refusals and schemas."""
    RECORDS["plain_short"](folder).rename(folder / "plain.csv")
    RECORDS["fatigue"](folder).rename(folder / "again.csv")
    _reference(folder)
    for name in ("recovered", "again"):
        (folder / name).mkdir()
    journal = of_kind("journal")["T1.journal"]
    for name, content in (("T1", journal), ("cut_end", journal[:-40_000]), ("cut", journal[:300])):
        (folder / f"{name}.journal").write_bytes(content)
    cohort_records.cohort(folder / "cohort", 2, people=2)
    (folder / "cohort" / "broken.h5").write_bytes(b"")
    with working_in(folder):
        run("fit plain.csv -o model.json")
        model = (folder / "model.json").read_text()
        (folder / "cut.json").write_text(model[:500])
        (folder / "future.json").write_text(json.dumps(json.loads(model) | {"schema_version": "9.0"}))
        schemas = [address.split(":")[-2] for address in run("schema")["out"].split()]
        more = [*(f"schema {name}" for name in schemas), *(f"{verb} --help" for verb in VERBS)]
        return {line: call(line) for line in (*REFUSED, *DONE, "schema", *more)}


WORDS = {"description", "summary", "title", "examples", "operationId", "tags"}


def rest(folder: Path) -> Any:
    """The routes of REST: parameters, bodies, answers and their statuses, without what is said about them."""

    def bare(value: Any, named: bool = False) -> Any:
        """`named`: keys are names of fields, whatever they are."""
        if isinstance(value, list):
            return [bare(part) for part in value]
        if not isinstance(value, dict):
            return value
        fields = "properties", "schemas", "paths", "responses"
        return {
            key: bare(part, key in fields and not named) for key, part in value.items() if named or key not in WORDS
        }

    document = create_app(Settings(data_dir=folder, rig_file=None)).openapi()
    return condensed(bare({"paths": document["paths"], "schemas": document["components"]["schemas"]}), folder)


def _reference(folder: Path) -> None:
    rows = [f"{k / 40:.4f},{1.5 if 80 < k < 240 else 0.5}" for k in range(320)]
    (folder / "reference.csv").write_text("\n".join(["time_s,torque_nm", *rows, ""]))

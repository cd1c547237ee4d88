"""The bill of materials: whole, valid, the same each time; licences that may go along; an audit that asked nobody."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import pytest

from deploy import soup
from deploy.technical_file import audit, sbom


@pytest.mark.slow
def test_it_holds_each_pin_of_the_locks_with_licence_and_hashes_the_same_each_time() -> None:
    text = sbom.build("1.0.0")
    bill = json.loads(text)
    pins = {(n, v) for lock in (soup.LOCK, soup.EXTRAS) for n, v, _ in soup.pins(lock.read_text("utf-8"))}
    assert {(one["name"], one["version"]) for one in bill["components"]} == pins
    for one in bill["components"]:
        assert one["purl"] == f"pkg:pypi/{one['name']}@{one['version']}"
        assert one["licenses"], one["name"]
        assert all(len(h["content"]) == 64 for h in one["externalReferences"][0]["hashes"])
        assert one["externalReferences"][0]["hashes"], one["name"]
    needed = {one["ref"]: one.get("dependsOn", []) for one in bill["dependencies"]}
    assert any(ref.startswith("pkg:pypi/numpy@") for ref in needed["stimrig"])
    assert any(ref.startswith("pkg:pypi/starlette@") for ref in needed[f"pkg:pypi/fastapi@{dict(pins)['fastapi']}"])
    assert sbom.build("1.0.0") == text


@pytest.mark.slow
def test_it_holds_to_cyclonedx_own_schema() -> None:
    bill = sbom.build("1.0.0")
    assert sbom.schema_faults(bill) == []
    few = json.loads(bill) | {"components": [{"type": "wish", "name": "x"}], "dependencies": []}
    assert sbom.schema_faults(json.dumps(few))


def licence_faults(**changed: Any) -> list[str]:
    return list(sbom.licence_faults({name for name, *_ in sbom.packages()}, sbom.licences() | changed))


def test_every_licence_may_go_along() -> None:
    assert licence_faults() == []


def test_a_licence_that_may_not_or_is_not_known_is_told() -> None:
    allowed, stated = sbom.licences()["allowed"], sbom.licences()["stated"]
    without = {name: why for name, why in allowed.items() if name != "LGPL-3.0-only"}
    told = licence_faults(allowed=without)
    assert {line.partition(":")[0] for line in told} == {"fpdf2", "psycopg", "psycopg-binary", "python-can"}
    assert all("LGPL-3.0-only is not allowed" in line for line in told)
    unknown = {name: one for name, one in stated.items() if name != "wrapt"}
    assert licence_faults(stated=unknown) == ["wrapt: no licence known; read it and state it in deploy/licences.toml"]
    viral = stated | {"wrapt": {"licence": "AGPL-3.0-only"}}
    assert licence_faults(stated=viral) == ["wrapt: AGPL-3.0-only is not allowed (deploy/licences.toml)"]
    assert licence_faults(stated=stated | {"numpy": {"licence": "MIT"}})[0].startswith("numpy: stated")


@pytest.mark.parametrize(
    ("licence", "may"),
    [
        ("MIT OR GPL-3.0-only", True),
        ("MIT AND GPL-3.0-only", False),
        ("Apache-2.0 WITH LLVM-exception", True),
        ("(MIT OR GPL-3.0-only) AND BSD-3-Clause", True),
    ],
)
def test_of_alternatives_one_of_several_together_all(licence: str, may: bool) -> None:
    stated = sbom.licences()["stated"] | {"wrapt": {"licence": licence}}
    assert (licence_faults(stated=stated) == []) is may


def test_a_package_that_was_not_asked_about_is_a_failure() -> None:
    found = {
        "dependencies": [
            {"name": "a", "skip_reason": "Dependency not found on PyPI and could not be audited: a (1)"},
            {"name": "b", "version": "2", "vulns": [{"id": "PYSEC-1"}]},
            {"name": "c", "version": "3", "vulns": []},
        ]
    }
    assert list(audit.faults(found)) == ["b 2: PYSEC-1", "not asked about: 1 of 3: a …"]
    assert list(audit.faults({"dependencies": found["dependencies"][2:]})) == []


def test_no_answer_is_no_good_answer(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    answer = subprocess.CompletedProcess([], 1, stdout="", stderr="trouble\nno network\n")
    monkeypatch.setattr(audit.subprocess, "run", lambda *_a, **_k: answer)
    assert audit.main() == 1
    assert capsys.readouterr().out.splitlines() == [
        "run.txt: no answer: no network",
        "centre.txt: no answer: no network",
    ]

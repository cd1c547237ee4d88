"""`stimrig test --adaptive`: a bank where one is asked for, and the best model where the structure does not fit."""

from __future__ import annotations

from typing import Any

import pytest

from stimrig.api.cli import main
from stimrig.api.cli.commands import test as verb
from stimrig.api.cli.session_report import bank_lines
from stimrig.api.client.errors import ServiceError


class Service:
    """What answers in the place of a client of the service."""

    def __init__(self, fails: bool) -> None:
        self.fails, self.improved = fails, []

    def __enter__(self) -> Service:
        return self

    def __exit__(self, *_: object) -> None: ...

    def improve(self, model_id: str, _progress: object) -> dict[str, Any]:
        self.improved.append(model_id)
        if self.fails:
            raise ServiceError("", "failed")
        return {"id": "best"}

    def model_file(self, model_id: str) -> str:
        return model_id

    def recording(self, _recording_id: str) -> bytes:
        return b""


@pytest.mark.parametrize(
    ("problem", "fails", "model"), [("", False, "plain"), ("misfit", False, "best"), ("misfit", True, "plain")]
)
def test_where_the_structure_does_not_fit_the_best_model_is_given(
    problem: str, fails: bool, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = Service(fails)
    document = {"model_id": "plain", "recording_id": "r", "adaptive": {"problem": problem}}
    monkeypatch.setattr(verb, "Client", lambda *_: service)
    monkeypatch.setattr(verb, "run_test", lambda *_, **__: document)
    assert verb.through("url", "token", "P1")["model"] == model
    assert service.improved == (["plain"] if problem else [])


def test_a_bank_is_asked_for_with_an_adaptive_test_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[dict[str, Any]] = []

    def on_own_services(*given: Any) -> dict[str, Any]:
        asked.append(given[-1])
        return {"test": {}, "model": {}, "recording": b""}

    monkeypatch.setattr(verb, "on_own_services", on_own_services)
    for options in (["--adaptive", "--bank"], ["--adaptive"]):
        assert main.run(["test", *options, "--json"]) == 0
    assert asked == [{"kind": "adaptive", "bank": True}, {"kind": "adaptive"}]
    assert main.run(["test", "--bank"]) == 2
    assert "--bank go with --adaptive" in capsys.readouterr().err and len(asked) == 2


@pytest.mark.parametrize(
    ("probable", "usable", "said"),
    [
        ({"unlike all": 0.07, "another person 2": 0.93}, 3, "another person 2 (93 %), unlike all (7 %)"),
        (None, 3, "3"),  # stopped before the first fit
        (None, 0, "none that can be used: a test as ever"),
    ],
)
def test_the_report_tells_whom_the_muscle_is_like(probable: dict[str, float] | None, usable: int, said: str) -> None:
    assert bank_lines(probable, usable) == [f"earlier models {said}"]
    assert bank_lines(None, None) == []

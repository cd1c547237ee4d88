"""`stimrig test --adaptive`: the best model where the structure does not fit."""

from __future__ import annotations

from typing import Any

import pytest

from stimrig.api.cli.commands import test as verb
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

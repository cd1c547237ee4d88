"""Rig and centre of neighbouring versions: messages that version 0.1 (c6ff60e) really sent, taken by this one.

`neighbours` is recorded by `python -m bench.neighbours OLD --write`, which also plays all four pairs as processes.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.outbox.chain import Position
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.messages import RefusedError
from stimrig.api.store.centre_tables import CentreItem
from tests.api.centre.conftest import Centre, run_centre

KEPT = Path(__file__).parent / "neighbours"
OLD_RIG = json.loads((KEPT / "old_rig.json").read_text("utf-8"))
OLD_CENTRE = json.loads((KEPT / "old_centre.json").read_text("utf-8"))


@pytest.fixture
def centre(tmp_path: Path) -> Iterator[Centre]:
    yield from run_centre(tmp_path / "centre")


@pytest.fixture
def rig(centre: Centre) -> Iterator[httpx.Client]:
    with centre.client(centre.key()) as http:
        yield http


def test_an_old_rig_is_understood_by_this_centre(centre: Centre, rig: httpx.Client) -> None:
    hello = {"chain": OLD_RIG["chain"], "seq": 0, "hash": "0" * 64, "utc": centre.clock.utc(), "version": "0.1.0"}
    assert rig.post("/v1/rig/hello", json=hello).json()["seq"] == 0
    taken = rig.post("/v1/rig/items", json=OLD_RIG).json()
    assert (taken["seq"], taken["hash"]) == (len(OLD_RIG["items"]), OLD_RIG["items"][-1]["hash"])
    kinds = {row.kind for row in centre.context.store.all(CentreItem)}
    assert kinds == {"begin", "participant", "test", "recording", "model", "decision", "audit"}
    assert not [kind for _, kind in centre.warnings() if kind in ("unreadable", "audit")], "every item was understood"
    with centre.client() as http:
        assert {one["participant"] for one in http.get("/v1/recordings").json()["recordings"]} == {"P1", "X0", "X1"}


def test_what_does_not_hold_is_refused_in_a_clear_line_and_nothing_of_it_is_taken(
    centre: Centre, rig: httpx.Client
) -> None:
    wrong = copy.deepcopy(OLD_RIG)
    wrong["items"][3]["body"]["more"] = 1
    refused = rig.post("/v1/rig/items", json=wrong)
    assert refused.status_code == 422 and "Item 4" in refused.json()["detail"]
    assert centre.context.store.all(CentreItem) == []


def answered(name: str) -> dict[str, Any]:
    return OLD_CENTRE[name]["json"]


def test_this_rig_understands_what_an_old_centre_answers() -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        found = OLD_CENTRE[f"{request.method} {request.url.path}"]
        return httpx.Response(found["status"], json=found["json"])

    link = Link("http://127.0.0.1:1", "key", Clock(), httpx.MockTransport(answer))
    assert link.hello({}) == Position(0, "0" * 64)
    assert link.items("", []).seq == answered("POST /v1/rig/items")["seq"]
    assert [one.bytes for one in link.wanted(100)] == [one["bytes"] for one in answered("GET /v1/rig/files")["files"]]
    with pytest.raises(RefusedError):  # it countersigns nothing: `stimrig.api.outbox.receipts` goes on without
        link.heads("", 0)

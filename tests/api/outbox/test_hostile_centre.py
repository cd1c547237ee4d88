"""A centre that means harm: it may keep what it is sent from coming over, and nothing else."""

from __future__ import annotations

import itertools

import httpx
import pytest

from stimrig.api.outbox import files
from tests.api.outbox.conftest import Rig, run
from tests.harness.fake_centre import KEY, FakeCentre, answer, problem

DAY_S = 86400.0


def test_a_centre_that_stands_elsewhere_each_time_is_asked_twice(rig: Rig) -> None:
    rig.participant("P1")
    asked = itertools.count(1)

    def line(_request: httpx.Request) -> httpx.Response:
        number = next(asked)
        return answer(200, seq=number, hash=f"{number:064x}")

    pusher = rig.pusher(line)
    pusher.turn()
    assert next(asked) == 3 and pusher._status().state == "wrong-answer"
    assert len({item.chain for item in rig.items()}) == 1


def test_a_chain_begins_anew_less_and_less_often(rig: Rig) -> None:
    rig.participant("P1")

    def line(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("hello"):
            return answer(200, seq=10**6, hash="f" * 64)
        return problem(409, "forked")

    run(rig.pusher(line), DAY_S)
    assert 2 <= len({item.chain for item in rig.items()}) <= 5


def test_files_that_nobody_named_fill_no_memory_and_are_looked_for_with_rests(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "MOST_UNKNOWN", 100)  # reached soon
    rig.session("P1")
    centre, drawn = FakeCentre(), itertools.count()

    def new() -> dict[str, object]:
        return {"sha256": f"{next(drawn):064x}", "bytes": 5, "have_bytes": 0}

    def line(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/v1/rig/files":
            most = int(request.url.params["limit"])
            return answer(200, files=[new() for _ in range(most)])
        return centre.handle(request)

    pusher = rig.pusher(line)
    began_s = rig.clock.now_s
    for _ in range(500):
        pusher.sleep(pusher.turn())
    assert len(pusher.files.damaged) == files.MOST_UNKNOWN < next(drawn) / 2
    assert rig.clock.now_s - began_s > 200


def test_a_file_that_is_asked_for_again_and_again_is_not_read_without_rest(rig: Rig) -> None:
    for _ in range(3):
        rig.recording("P1", size=5000)
    centre = FakeCentre()

    def line(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/v1/rig/files":
            named = [item for held in centre.chains.values() for item in held if item["file"]]
            listed = [{"sha256": i["file"], "bytes": i["file_bytes"], "have_bytes": i["file_bytes"]} for i in named]
            return answer(200, files=(listed * 1000)[: int(request.url.params["limit"])])
        if request.method == "PUT":
            return answer(200, have_bytes=int(request.url.params["offset"]), whole=True)
        return centre.handle(request)

    pusher = rig.pusher(line)
    began_s = rig.clock.now_s
    for _ in range(300):
        pusher.sleep(pusher.turn())
    assert rig.clock.now_s - began_s > 200


def test_no_cookie_is_kept_or_sent_back(rig: Rig) -> None:
    rig.session("P1")
    centre, drawn, sent = FakeCentre(), itertools.count(), []

    def line(request: httpx.Request) -> httpx.Response:
        sent.append(request.headers.get("Cookie"))
        given = centre.handle(request)
        return httpx.Response(
            given.status_code, content=given.content, headers=[("Set-Cookie", f"c{next(drawn)}=x; Path=/")]
        )

    pusher = rig.pusher(line)
    run(pusher, 100)
    assert pusher._status().state == "current"
    assert len(sent) > 3 and not any(sent) and not list(pusher.link.http.cookies.jar)


def test_a_key_that_is_sent_back_is_shown_nowhere(rig: Rig) -> None:
    def line(request: httpx.Request) -> httpx.Response:
        return answer(500, title="broken", detail=f"{'x' * 150} {request.headers}, {request.headers['Authorization']}")

    pusher = rig.pusher(line)
    run(pusher, 10)
    shown = (rig.folder / "outbox.json").read_text()
    assert "broken" in shown and KEY[:8] not in shown

    def echo(request: httpx.Request) -> httpx.Response:
        raise httpx.ReadError(f"got {request.headers['Authorization']}")

    pusher = rig.pusher(echo)
    run(pusher, 10)
    shown = (rig.folder / "outbox.json").read_text()
    assert "got Bearer" in shown and KEY[:8] not in shown

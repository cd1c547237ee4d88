"""A traced request: its steps are told afterwards, and nothing that the rig does is another thing for it."""

from __future__ import annotations

import json
import math
import socket
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig.acquire import run as acquire_run
from stimrig.rig.adapters.stop_server import StopServer
from stimrig.rig.control import trace
from stimrig.rig.control.rig import obey, read_request
from stimrig.rig.control.trace import Steps, sound
from stimrig.rig.messages import FinishedEvent, StopEvidence
from stimrig.rig.requests import StartRequest, StopRequest
from tests.rig.live import LiveRig

TRACE, SPAN = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
KNOWN = f"00-{TRACE}-{SPAN}-01"
MALFORMED = [
    "", "x", KNOWN.upper(), KNOWN + "0", f"00-{'0' * 32}-{SPAN}-01", f"00-{TRACE}-{'0' * 16}-01",
    f"01-{TRACE}-{SPAN}-01", f" {KNOWN}", f"{KNOWN}\n", "x" * 5000, 3, 1e300, True, [KNOWN],
    {"traceparent": KNOWN}, [[[[[]]]]],
]  # fmt: skip
STEPS = ["received", "checked", "begun", "first_sent", "first_acknowledged", "ended", "sealed"]


@pytest.mark.parametrize("given", MALFORMED, ids=range(len(MALFORMED)))
def test_what_is_no_trace_context_is_ignored(given: Any) -> None:
    assert sound(given) == ""


def play(folder: Path, monkeypatch: pytest.MonkeyPatch, traceparent: object, stop: bool = False) -> tuple[Any, ...]:
    """A test as it comes over the socket: what the device got and when, the journal's bytes, the end."""
    folder.mkdir()
    live = LiveRig(folder, monkeypatch)
    journals: list[bytes] = []
    finish = live.rig.store.finish
    monkeypatch.setattr(
        live.rig.store, "finish", lambda path, *more: journals.append(path.read_bytes()) or finish(path, *more)
    )
    fields = {} if traceparent is None else {"traceparent": traceparent}
    line = json.dumps({"kind": "start", "id": 7, "plan": live.plan("one").model_dump(), **fields})
    reply = live.ask(obey(live.rig, read_request(line.encode())))
    assert reply.ok, reply
    if stop:
        live.wait_pulses(9)
        live.stop("enough")
        live.wait("latched")
    else:
        live.wait("ready")
    done = [(one.index, one.pulse_width_us, one.written_s, one.acknowledged_s) for one in live.rig.pair.gate.done]  # type: ignore[union-attr]
    asked, finished = live.machine.asked, live.finished
    live.close()
    return done, journals, asked, finished


@pytest.mark.parametrize("given", [KNOWN, "x" * 5000, [[[]]]], ids=["known", "long", "nested"])
@pytest.mark.parametrize("stop", [False, True], ids=["to-its-end", "stopped"])
def test_no_pulse_is_another_one_or_later_for_being_traced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: object, stop: bool
) -> None:
    """In virtual time each wait counts: pulses, their times, and how often anybody was waited for are equal."""
    plain, traced = (play(tmp_path / name, monkeypatch, one, stop) for name, one in (("a", None), ("b", given)))
    assert len(plain[0]) > 8
    assert repr(plain[0]) == repr(traced[0]), "to the last bit, on the same clock"
    assert plain[2] == traced[2]
    assert (
        len(plain[1][0]) == len(traced[1][0])
        and b"traceparent" not in traced[1][0]
        and TRACE.encode() not in traced[1][0]
    )
    assert plain[3].traced is None and "traced" not in plain[3].model_dump()
    assert (traced[3].traced is not None) is (given == KNOWN)
    later = {"traced": None, "recording_id": "", "recording_path": "", "file_sha256": "", "last_sample_unix_s": 0}
    ends = [one[3].model_copy(update=later | {"summary": {}}) for one in (plain, traced)]
    assert ends[0] == ends[1]


def test_the_sender_knows_nothing_of_tracing() -> None:
    for module in ("gate.py", "acquire/run.py", "acquire/receiver.py", "acquire/pauses.py", "train.py", "journal.py"):
        assert "trace" not in (Path(acquire_run.__file__).parents[1] / module).read_text("utf-8").lower(), module


def test_the_steps_of_a_test_are_told_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done, _, _, finished = play(tmp_path / "a", monkeypatch, KNOWN)
    told = finished.traced
    assert told is not None and told.traceparent == KNOWN
    assert sorted(told.at_unix_s, key=lambda step: told.at_unix_s[step]) == STEPS
    first = next(one for one in done if not math.isnan(one[2]))
    between_s = told.at_unix_s["first_acknowledged"] - told.at_unix_s["first_sent"]
    assert between_s == pytest.approx((first[3] - first[2]) / 4.0, abs=1e-6), "real seconds of a rig 4 times as fast"
    again = FinishedEvent.model_validate_json(finished.model_dump_json())
    assert again.traced == told


def test_a_test_that_ends_before_its_first_pulse_tells_what_it_has(make: Any) -> None:
    live = make()
    starting = live.begin(live.rig.start(live.plan("one"), "", KNOWN))
    live.until(lambda: live.states[-1] in ("arming", "running"))
    live.stop("no")
    live.until(starting.done.is_set)
    live.wait("latched")
    at = live.finished.traced.at_unix_s
    assert "received" in at and "sealed" in at and "first_sent" not in at


def test_steps_that_cannot_be_told_break_nothing(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    live = make()
    monkeypatch.setattr(trace, "Traced", lambda **_: 1 / 0)
    live.ask(live.rig.start(live.plan("one", hold_s=0.5), "", KNOWN))
    live.wait("ready")
    assert live.finished.outcome == "completed" and live.finished.traced is None


def test_a_train_of_a_calibration_has_no_steps_of_the_test_before(make: Any) -> None:
    live = make()
    live.ask(live.rig.start(live.plan("one", hold_s=0.5), "", KNOWN))
    live.wait("ready")
    assert live.rig.player._steps is not None
    live.play("two", hold_s=0.5)
    assert live.finished.traced is None


@pytest.mark.parametrize("given", [KNOWN, *MALFORMED], ids=range(1 + len(MALFORMED)))
def test_a_stop_is_a_stop_whatever_its_trace_context_is(tmp_path: Path, given: Any) -> None:
    asked: list[str] = []

    def stop(reason: str, _by: str) -> Future[StopEvidence]:
        asked.append(reason)
        future: Future[StopEvidence] = Future()
        future.set_result(StopEvidence(confirmed=True, detail="fallen"))
        return future

    server = StopServer(stop)
    server.open(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(str(tmp_path / "s"))
        connection.sendall(
            json.dumps({"kind": "stop", "id": 7, "reason": "ouch", "traceparent": given}).encode() + b"\n"
        )
        body = json.loads(connection.makefile("rb").readline())["body"]
    server.close()
    assert asked == ["ouch"] and body["confirmed"]
    assert ("traced" in body) is (given == KNOWN)
    if given == KNOWN:
        at = body["traced"]["at_unix_s"]
        assert body["traced"]["traceparent"] == KNOWN and at["received"] <= at["confirmed"]


def test_who_does_not_trace_sends_nothing_of_it() -> None:
    """An older rig refuses what it does not know."""
    assert "traceparent" not in StopRequest(reason="r").model_dump_json()
    assert "traceparent" not in StartRequest.model_construct(plan=None).model_dump_json()
    assert Steps(None, None or _Still()).told(None, None) is None  # type: ignore[arg-type]


class _Still:
    speed = 1.0

    def now_s(self) -> float:
        return 0.0

    def unix_s(self) -> float:
        return 0.0

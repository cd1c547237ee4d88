"""What takes long on the wire: every pair of devices, half a minute of the soak, and a test that stops itself."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from stimrig.api.settings import Settings
from stimrig.api.web.app import create_app
from stimrig.hardware_sim import load_cells, stimulators
from tests.api.conftest import TOKEN, Server, wait_done
from tests.harness.looks_first import LooksFirst
from tests.harness.processes import Bench, RigClient, kill_hard, short_plan
from tests.harness.soak import soak
from tests.wire.test_rig import STEPS, check_recording, felt_after, start, stops_when_asked

pytestmark = [pytest.mark.wire, pytest.mark.campaign]
PATIENCE_S = 300.0

STIMULATORS = tuple(stimulators.STIMULATORS)
TRANSPORTS = tuple(load_cells.TRANSPORTS)
CELLS = {
    f"{name} x{count}" if count > 1 else name: ("--cell", name, "--samples-per-frame", str(count))
    for name, cell in load_cells.CELLS.items()
    for count in {min(cell.layouts), max(cell.layouts)}
}
"""Every emulated cell with its fewest and its most samples per frame, as options of the emulator."""
MOST = {
    "align_ms": 1.0,
    "ack_ms": 10.0,
    "stop_ms": 100.0,
    "fault_ms": 250.0,
    "silence_ms": 30.0,
    "dropped_percent": 10.0,
}
"""Bounds of the figures of a pair, on a machine that does nothing else."""


def check_all(bench: Bench) -> dict[str, float]:
    """The whole suite on one pair; a few figures."""
    client = bench.start_rig()
    client.ask("subscribe")
    assert client.start(short_plan("plays"))["ok"]
    figures = check_recording(client.wait_finished("plays"), bench.felt())
    figures["stop_ms"] = stops_when_asked(bench, client)
    figures["fault_ms"] = stops_when_unheard(bench, client)
    figures["silence_ms"] = says_nothing_when_killed(bench, client)
    return figures


def stops_when_unheard(bench: Bench, client: RigClient) -> float:
    """No acks: stopped, told, kept; milliseconds from the fault to the last pulse."""
    start(bench, client, "unheard")
    injected = bench.fault(cmd="fault", name="no_ack", on=True)
    event = client.wait_finished("unheard")
    assert event["outcome"] == "fault"
    assert "not acknowledged" in event["reason"]
    # no pulse goes out before the one ahead of it is acknowledged
    assert felt_after(bench, injected["monotonic_s"]) <= 1
    last_ms = 1e3 * (bench.felt()[-1]["monotonic_s"] - injected["monotonic_s"])
    bench.fault(cmd="fault", name="no_ack", on=False)
    client.wait_state("latched")
    time.sleep(0.1)
    rearmed = client.rearm("nurse")
    assert rearmed["ok"], rearmed
    return last_ms


def says_nothing_when_killed(bench: Bench, client: RigClient) -> float:
    """The host's death ends stimulation at once: each pulse was a command. Then uncertain, asked, not resumed."""
    start(bench, client, "killed")
    assert bench.rig is not None
    kill_hard(bench.rig)
    died_s = time.monotonic()
    time.sleep(1.5 / bench.speed)  # longer than any device's own watchdog
    after = bench.felt()
    assert felt_after(bench, died_s) <= 1  # a command may have been on its way
    again = bench.start_rig()
    assert again.status()["state"] == "uncertain"
    again.ask("subscribe")
    assert len(bench.felt()) == len(after)
    assert again.rearm("nurse")["ok"]
    assert again.start(short_plan("next"))["ok"]
    event = again.wait_finished("next")
    assert event["outcome"] == "completed", event
    return 1e3 * (after[-1]["monotonic_s"] - died_s)


# at the speed of the world: a backlog of text frames is read hardly faster than twice that
@pytest.mark.parametrize("pair", list(itertools.product(STIMULATORS, CELLS, TRANSPORTS)), ids=" ".join)
def test_every_pair_behaves(make_bench: Callable[..., Bench], pair: tuple[str, str, str]):
    stimulator, cell, transport = pair
    options = ["--stimulator", stimulator, "--load-cell", transport, *CELLS[cell], "--noise-seed", "7"]
    figures = check_all(make_bench(*options))
    over = {name: figures[name] for name, most in MOST.items() if not figures[name] <= most}
    assert not over


def test_a_rehastim2_is_kept_alive_through_a_rest_and_lets_go_of_a_dead_host(make_bench: Callable[..., Bench]):
    """Its watchdog strikes 1200 ms after the last command: the bound of its silence, here with single pulses."""
    bench = make_bench("--stimulator", "rehastim2")
    client = bench.start_rig()
    client.ask("subscribe")
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 3.0}}
    assert client.start(short_plan("rests", segments=[rest, *STEPS[1:], rest]))["ok"]
    client.wait_state("running")
    while len(bench.felt()) < 20:
        time.sleep(0.02)
    commands = bench.state()["commands"]
    assert 5 <= commands["4"] <= 12  # 3 s of rest, a keep-alive each 0.3 s
    assert bench.rig is not None
    alive_s = bench.state()["time_s"]
    kill_hard(bench.rig)
    died_s = bench.state()["time_s"]
    asleep_s = [died_s]  # when the device was last seen connected, on its own clock
    while (now := bench.state())["mode"] != "none":
        assert now["time_s"] - died_s < 10
        asleep_s.append(now["time_s"])
        time.sleep(0.01)
    assert asleep_s[-1] - died_s <= 1.2 and now["time_s"] - alive_s >= 0.9  # a keep-alive each 0.3 s before
    assert sum(pulse["time_s"] > died_s for pulse in bench.felt()) <= 1  # a command may have been on its way


SEGMENTS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
    {"name": "prbs", "sequence": "prbs", "settings": {"bits": 6, "clock_pulses": 2}},
    {"name": "ramp", "sequence": "ramp", "settings": {"up_s": 3.0, "down_s": 3.0}},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
]
"""A test of 11 s; the second one runs beside fits of the first."""


def test_no_sample_is_lost_while_fits_run_beside():
    found = soak(0.5, every_minutes=0.25, patient=True, segments=SEGMENTS)
    assert found["lost_samples"] == 0
    assert found["completed"] == found["tests"] == 2, found
    assert found["samples"] >= 30_000
    assert found["fits_beside"] >= 1
    assert found["alignment_error_ms"] < 1.0
    assert found["pulses_felt"] == found["pulses_sent"]
    assert found["state"] == "ready"


def test_a_test_stops_itself_and_is_identified(tmp_path: Path) -> None:
    """By the service and its real adviser; `test_adaptive*.py` of tests/rig and tests/api play the parts."""
    bench = Bench(tmp_path / "bench", "--noise-seed", "13")
    try:
        bench.start_rig().wait_state("ready")
        folder = tmp_path / "service"
        app = create_app(Settings(data_dir=folder, admin_token=TOKEN, rig_socket=bench.socket, port=0))
        with Server(app) as url, httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=PATIENCE_S) as client:
            client.post("/v1/participants", json={"code": "P017"})
            target = {"curve_percent": 4.0, "step_percent": 4.0}
            document = wait_done(client, begin_test(client, target), PATIENCE_S)
    finally:
        bench.close()
    told, summary = document["adaptive"], document["summary"]
    assert document["state"] == "completed", document["reason"]
    assert told["decisions"], told
    if told["ended"] == "known-enough":
        assert told["problem"] == ""
        assert told["knowledge"]["curve_percent"] <= 4.0
        assert summary["duration_s"] < 38.7
    else:  # the machine was too busy: answers came late, or pulses; then the fixed plan played, and it never waited
        assert told["ended"] in ("fixed-rest", "time")
        kinds = {row["kind"] for row in told["decisions"] if not (row.get("late") or row.get("refused"))}
        assert kinds <= {"next", "misfit"}
        assert told["problem"] == "" or ("misfit" in kinds and (summary["dropped_pulses"] > 0 or summary["warnings"]))
    assert document["fit"]["fit_percent"] > 90.0


def begin_test(client: httpx.Client, target: dict[str, float]) -> str:
    """Ask until the rest between two tests is over; the test's id. What it can reach is computed before."""
    end = time.monotonic() + PATIENCE_S
    body = {"participant": "P017", "kind": "adaptive", "target": target}
    answer = client.post("/v1/preview", json=body)
    assert answer.status_code == 200, answer.text
    while True:
        answer = client.post("/v1/tests", json=body)
        if answer.status_code == 202 or "rest_between_tests_s" not in answer.text:
            assert answer.status_code == 202, answer.text
            return answer.json()["id"]
        assert time.monotonic() < end, answer.text
        time.sleep(0.2)

"""The same behaviour on every kind of device: one pair in a campaign's run, and each of them."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig.hardware_sim import load_cells, stimulators
from stimrig.rig import archive
from tests.harness.processes import Bench, RigClient, kill_hard, short_plan

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

SAME_CLOCK_S = 2e-4
"""Two processes read the same clock; between the device's doing and its answer is at least this."""

CELLS = {
    f"{name} x{count}" if count > 1 else name: ("--cell", name, "--samples-per-frame", str(count))
    for name, cell in load_cells.CELLS.items()
    for count in {min(cell.layouts), max(cell.layouts)}
}
"""Every emulated cell with its fewest and its most samples per frame, as options of the emulator."""
MOST = {"stop_ms": 100.0, "fault_ms": 250.0, "silence_ms": 30.0, "dropped_percent": 10.0}
"""Bounds of the figures of a pair, on a machine that does nothing else."""
HOLD = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 8.0, "off_s": 0.0, "repeats": 1}},
]


def felt_after(bench: Bench, time_s: float) -> int:
    """How many pulses the emulated electrodes felt after a monotonic time."""
    return sum(pulse["monotonic_s"] > time_s for pulse in bench.felt())


def check_all(make_bench: Callable[..., Bench], stimulator: str, cell: str, transport: str) -> dict[str, float]:
    """The whole suite on one pair, at the speed of the world; a few figures."""
    bench = make_bench("--stimulator", stimulator, "--load-cell", transport, *CELLS[cell], "--noise-seed", "7")
    client = bench.start_rig()
    client.ask("subscribe")
    figures = plays_and_records(bench, client)
    figures["stop_ms"] = stops_when_asked(bench, client)
    figures["fault_ms"] = stops_when_unheard(bench, client)
    figures["silence_ms"] = says_nothing_when_killed(bench, client)
    return figures


def plays_and_records(bench: Bench, client: RigClient) -> dict[str, float]:
    """A test ends well, and the file holds what the electrodes felt and the muscle gave."""
    reply = client.start(short_plan("plays"))
    assert reply["ok"], reply
    event = client.wait_finished("plays")
    assert event["outcome"] == "completed", event
    with h5py.File(event["recording_path"]) as file:
        assert archive.verify(Path(event["recording_path"])) == file.attrs["content_sha256"]
        status, sent = file["pulses/status"][:], file["pulses/sent_pulse_width_us"][:]
        torque_nm, time_s = file["torque/torque_nm"][:], file["torque/time_s"][:]
        ack_s = (file["pulses/acknowledged_time_s"][:] - file["pulses/written_time_s"][:])[status == 0]
    fired = bench.felt()
    assert [p["width_us"] for p in fired] == sent[status == 0].tolist()
    assert {p["current_ma"] for p in fired} == {20.0}
    assert all(p["balanced"] for p in fired)
    assert set(np.unique(status)) <= {0, 1, 2}  # how many are dropped is the machine's doing: a figure of the bench
    assert np.sum(status == 2) == event["summary"]["dropped_pulses"]
    assert np.sum(status == 0) >= 20
    assert 0 < np.median(ack_s) < 0.01  # one that is heard after 25 ms drops the next pulse
    assert len(time_s) > 0.95 * 1600 * event["summary"]["duration_s"]
    assert np.all(np.diff(time_s) > 0)
    assert event["summary"]["lost_samples"] == 0
    assert np.max(torque_nm) > 1.0
    assert abs(np.median(torque_nm[time_s < 0.4])) < 0.2
    assert event["summary"]["alignment"]["error_ms"] < 1.0
    return {"dropped_percent": 100 * float(np.mean(status[status != 1] == 2))}


def holding(bench: Bench, client: RigClient, name: str) -> None:
    """A test that stimulates steadily."""
    before = len(bench.felt())
    reply = client.start(short_plan(name, segments=HOLD))
    assert reply["ok"], reply
    end_s = time.monotonic() + 15
    while len(bench.felt()) < before + 20:
        assert time.monotonic() < end_s, client.status()
        time.sleep(0.02)


def stops_when_asked(bench: Bench, client: RigClient) -> float:
    """Confirmed by device and torque, latched, re-armed; milliseconds from request to last pulse."""
    holding(bench, client, "asked")
    asked_s = time.monotonic()
    evidence = client.ask("stop", reason="enough", by="nurse")["body"]
    answered_s = time.monotonic()
    assert evidence["confirmed"], evidence
    assert client.wait_finished("asked")["outcome"] == "stopped"
    assert client.wait_state("latched")["reason"] == "enough (by nurse)"
    assert client.rearm("nurse")["ok"]
    assert felt_after(bench, asked_s) <= 4  # of 25 ms each
    assert felt_after(bench, answered_s + SAME_CLOCK_S) == 0
    return 1e3 * (bench.felt()[-1]["monotonic_s"] - asked_s)


def stops_when_unheard(bench: Bench, client: RigClient) -> float:
    """No acks: stopped, told, kept; milliseconds from the fault to the last pulse."""
    holding(bench, client, "unheard")
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
    holding(bench, client, "killed")
    assert bench.rig is not None
    kill_hard(bench.rig)
    died_s = time.monotonic()
    time.sleep(1.5)  # longer than any device's own watchdog
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


def test_a_pair_behaves(make_bench: Callable[..., Bench]):
    check_all(make_bench, "rehastim2", "canopen", "slcan")


@pytest.mark.parametrize(
    "pair", list(itertools.product(stimulators.STIMULATORS, CELLS, load_cells.TRANSPORTS)), ids=" ".join
)
def test_every_pair_behaves(make_bench: Callable[..., Bench], pair: tuple[str, str, str]):
    figures = check_all(make_bench, *pair)
    assert {name: figures[name] for name, most in MOST.items() if not figures[name] <= most} == {}


def test_a_rehastim2_is_kept_alive_through_a_rest_and_lets_go_of_a_dead_host(make_bench: Callable[..., Bench]):
    """Its watchdog strikes 1200 ms after the last command: the bound of its silence, here with single pulses."""
    bench = make_bench("--stimulator", "rehastim2")
    client = bench.start_rig()
    client.ask("subscribe")
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 3.0}}
    assert client.start(short_plan("rests", segments=[rest, *HOLD[1:], rest]))["ok"]
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

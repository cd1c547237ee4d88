"""A whole test over the wire: what is sealed is what was played, and what the muscle felt is what was sealed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig import align, archive
from stimrig.rig.acquire.run import CLIMB
from stimrig.rig.signals import PulseStatus
from tests.harness.processes import Bench, short_plan

pytestmark = pytest.mark.wire


def play(bench: Bench, plan: dict[str, Any], timeout_s: float = 90.0) -> dict[str, Any]:
    """Play a plan to its end and return the finished event."""
    client = bench.start_rig()
    client.ask("subscribe")
    reply = client.start(plan)
    assert reply["ok"], reply
    return client.wait_finished(plan["test_id"], timeout_s)


def check_recording(bench: Bench, event: dict[str, Any]) -> None:
    """The file is whole, hashed, and agrees with what the electrodes felt."""
    path = Path(event["recording_path"])
    assert hashlib.sha256(path.read_bytes()).hexdigest() == event["file_sha256"]
    with h5py.File(path) as file:
        assert archive.verify(path) == file.attrs["content_sha256"]
        assert file.attrs["outcome"] == "completed"
        status = file["pulses/status"][:]
        planned = file["pulses/pulse_width_us"][:]
        sent = file["pulses/sent_pulse_width_us"][:]
        acknowledged = status == 0
        assert np.array_equal(status == 1, planned < 10)
        # a busy machine drops late ones, tells how many, and does nothing else
        assert set(status) <= {PulseStatus.ACKNOWLEDGED, PulseStatus.REST, PulseStatus.DROPPED}
        assert np.sum(status == PulseStatus.DROPPED) == event["summary"]["dropped_pulses"]
        assert np.sum(acknowledged) >= 20
        whole = np.trunc(planned)
        assert np.all(sent[acknowledged] <= whole[acknowledged])
        dropped = np.flatnonzero(status == PulseStatus.DROPPED)  # after each the width may have to climb back
        climbs = [np.any((dropped < index) & (dropped >= index - 2 * CLIMB)) for index in range(len(planned))]
        as_planned = acknowledged & ~np.array(climbs)
        assert np.any(as_planned) and np.array_equal(sent[as_planned], whole[as_planned])
        felt = bench.felt()
        assert [p["width_us"] for p in felt] == list(sent[acknowledged])
        assert {p["current_ma"] for p in felt} == {20.0}
        assert all(p["balanced"] for p in felt)
        delay = file["pulses/acknowledged_time_s"][:][acknowledged] - file["pulses/written_time_s"][:][acknowledged]
        assert np.all(delay >= 0)
        assert 0 < np.median(delay) < 0.01  # one that is heard after 25 ms drops the next pulse
        time_s = file["torque/time_s"][:]
        assert np.all(np.diff(time_s) > 0)
        assert np.all(np.diff(file["torque/counter"][:]) == 1)
        assert len(time_s) == pytest.approx(event["summary"]["duration_s"] * 1600, abs=20)
        assert file["torque/gaps"].shape == (0, 2)
        assert json.loads(file.attrs["configuration"])["plan"]["test_id"] == event["test_id"]
        for name in ("torque/torque_nm", "pulses/pulse_width_us", "segments/start_s"):
            assert file[name].attrs["unit"]
            assert file[name].attrs["description"]


@pytest.mark.parametrize("transport", ["socketcand", pytest.param("slcan", marks=pytest.mark.campaign)])
def test_what_is_sealed_is_what_was_felt(make_bench: Callable[..., Bench], transport: str):
    bench = make_bench("--load-cell", transport, "--noise-seed", "5")
    event = play(bench, short_plan("t"))
    check_recording(bench, event)


@pytest.mark.campaign  # it compares times of the computer; tests/rig/test_receivers.py aligns in virtual time
def test_aligned_times_are_those_of_the_muscle(make_bench: Callable[..., Bench]):
    """The emulator knows when each pulse was felt; the recording's sync edges must lie there."""
    bench = make_bench("--clock-ppm", "-200", "--clock-jitter-us", "100")
    event = play(bench, short_plan("align"))
    felt_s = np.array([p["monotonic_s"] for p in bench.felt()])
    with h5py.File(event["recording_path"]) as file:
        written_s = file["pulses/written_time_s"][:]
        written_s = written_s[np.isfinite(written_s)]
        edges_s = file["torque/time_s"][:][file["torque/sync"][:] == 1]
    assert len(edges_s) == len(felt_s) == len(written_s)
    # the muscle's clock and the test's differ by a constant; what is left is line delay and alignment error
    since_first = (felt_s - felt_s[0]) - (edges_s - edges_s[0])
    assert np.median(np.abs(since_first)) < 1e-3
    assert np.median(np.abs(edges_s - written_s)) < 1e-3
    with h5py.File(event["recording_path"]) as file:
        counter, host_s, time_s = (file[f"torque/{name}"][:] for name in ("counter", "host_time_s", "time_s"))
    no_sync = np.full(len(counter), 255, np.uint8)
    without, found = align.align(counter / 1600, host_s, no_sync, written_s, 1600.0)
    assert found.method == "regression"
    assert np.median(np.abs(without - time_s)) < 1e-3  # 0.3 ms when the machine is not shared
    assert event["summary"]["alignment"]["error_ms"] < 3.0

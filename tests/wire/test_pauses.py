"""The rig's process stands still in a test on the wire, while the devices go on: a gap, and the test goes on."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig.rig.config import EMULATOR_WATCH
from stimrig.rig.signals import PulseStatus
from tests.harness.processes import Bench, control
from tests.wire.test_faults import start

pytestmark = [pytest.mark.wire, pytest.mark.campaign]  # tests/rig/test_pauses.py does it in virtual time

STOOD_S = 0.15
"""With what a shared machine may stand still by itself less than a second in all."""


@pytest.mark.parametrize("transport", ["socketcand", "slcan"])
def test_a_rig_that_stands_still_goes_on_and_loses_no_sample(make_bench: Callable[..., Bench], transport: str):
    bench = make_bench("--noise-seed", "7", "--load-cell", transport)
    client = start(bench)
    assert bench.rig is not None
    for _ in range(3):
        bench.rig.popen.send_signal(signal.SIGSTOP)
        time.sleep(STOOD_S)
        bench.rig.popen.send_signal(signal.SIGCONT)
        time.sleep(0.5)
    event = client.wait_finished("t")
    assert (event["outcome"], event["summary"]["lost_samples"]) == ("completed", 0), event["reason"]
    pauses = event["summary"]["pauses"]
    assert sum(pause["for_s"] for pause in pauses) >= 3 * (STOOD_S - 0.03), "two that follow one another may be one"
    assert max(pause["blocked_s"] for pause in pauses) >= STOOD_S - 0.03
    assert "the test went on" in event["summary"]["notes"][0]
    with h5py.File(Path(event["recording_path"])) as file:
        status, sent_us = file["pulses/status"][:], file["pulses/sent_pulse_width_us"][:]
        planned_s = file["pulses/planned_time_s"][:]
    left_out = np.flatnonzero(status == PulseStatus.DROPPED)
    assert len(left_out) >= 3 * round(40 * (STOOD_S - 0.03))
    for pause in pauses:  # after each the width climbs from nothing
        after = np.flatnonzero((planned_s > pause["at_s"]) & np.isfinite(sent_us))[:1]
        assert len(after) and sent_us[after[0]] <= 50
    felt = control(bench.emulator.ready["control"], {"cmd": "pulses", "since": 0})["pulses"]
    assert all(two["time_s"] - one["time_s"] >= 0.008 for one, two in pairwise(felt))


def test_one_that_stands_still_for_longer_ends_its_test_and_nothing_follows(make_bench: Callable[..., Bench]):
    bench = make_bench("--noise-seed", "7")
    client = start(bench)
    assert bench.rig is not None
    bench.rig.popen.send_signal(signal.SIGSTOP)
    time.sleep(0.2)
    before = control(bench.emulator.ready["control"], {"cmd": "pulses", "since": 0})["pulses"]
    time.sleep(1.0 + EMULATOR_WATCH["stale_torque_s"])
    bench.rig.popen.send_signal(signal.SIGCONT)
    event = client.wait_finished("t")
    assert event["outcome"] == "fault" and "the computer was blocked for" in event["reason"]
    assert control(bench.emulator.ready["control"], {"cmd": "pulses", "since": 0})["pulses"] == before
    assert client.status()["state"] == "latched"

"""A guided calibration over the wire: the electrodes feel what was asked for, and nothing between the steps."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig.control.sealing import MAY_BE_FELT
from stimrig.rig.signals import PulseStatus
from tests.harness.processes import Bench, RigClient, short_plan

pytestmark = pytest.mark.wire


def step(client: RigClient) -> dict[str, Any]:
    reply = client.ask("calibrate-step", direction="up")
    assert reply["ok"], reply
    status = client.wait_state("calibrating", "latched")
    assert status["state"] == "calibrating", status
    return status["calibration"]


def start(client: RigClient, name: str, **fields: Any) -> dict[str, Any]:
    return client.ask("calibrate-start", calibration_id=name, participant="P01", by="therapist", **fields)


def test_a_calibration_from_start_to_a_test(shared: tuple[Bench, RigClient]):
    bench, client = shared
    before = len(bench.felt())
    reply = start(client, "cal", step_us=25.0, train_s=0.5, max_pulse_width_us=205.0)
    assert reply["ok"], reply
    assert reply["body"]["state"] == "calibrating"
    assert len(bench.felt()) == before  # opening sends nothing
    refused = client.ask("start", plan=short_plan("no"))["problem"]
    assert refused["code"] == "busy"
    assert "finish or discard" in refused["detail"]
    shown = {"pulse_width_us": 0}
    for threshold, width_us in (("sensory", 25), ("motor", 150), ("comfort", 200)):
        while shown["pulse_width_us"] < width_us:  # a train that was lost to a busy machine is sent again
            shown = step(client)
        reply = client.ask("calibrate-mark", threshold=threshold)
        assert reply["body"]["calibration"]["marks_us"][threshold] == shown["pulse_width_us"]
    over = client.ask("calibrate-step", direction="up")["problem"]
    assert over["code"] == "refused"
    assert "marked comfort maximum" in over["detail"]
    pulses = [round(p["width_us"]) for p in bench.felt()[before:]]
    trains = shown["trains"]
    assert all(t["pulses"] <= 20 for t in trains), trains
    # one that was not felt whole is sent again; after a pause of the computer its pulses climb
    widths_us = [width_us for width_us, _ in groupby(t["pulse_width_us"] for t in trains if t["pulses"])]
    assert widths_us == [25, 50, 75, 100, 125, 150, 175, 200]
    assert set(widths_us) <= set(pulses) and max(pulses) == 200
    rise_nm = [t["torque_rise_nm"] for t in trains if t["torque_rise_nm"] is not None]
    assert rise_nm[-1] > 5 * rise_nm[0]
    result = client.ask("calibrate-finish", by="therapist")["body"]
    waiting = client.status()["calibrated"]
    assert waiting["result"] == result
    assert client.ask("calibrate-stored", calibration_id=waiting["calibration_id"])["body"]["calibrated"] is None
    profile = result["profile"]
    assert profile["max_pulse_width_us"] == 200.0
    assert profile["expires_at_utc"] > profile["set_at_utc"]
    assert len(result["recordings"]) == len(trains)
    acknowledged = 0
    for train, path in zip(trains, result["recordings"], strict=True):
        with h5py.File(path) as file:
            status = file["pulses/status"][:]
        sure = int(np.sum(status == PulseStatus.ACKNOWLEDGED))
        assert sure <= train["pulses"] == int(np.isin(status, MAY_BE_FELT).sum())  # what may be felt counts as felt
        assert train["pulses"] - sure <= 1  # none follows one that is not acknowledged
        acknowledged += sure
    # one that was not acknowledged need not have been felt
    assert acknowledged <= len(pulses) <= sum(train["pulses"] for train in trains)
    with h5py.File(result["recordings"][-1]) as file:
        assert file.attrs["kind"] == "calibration"
        assert np.nanmax(file["pulses/sent_pulse_width_us"][:]) == 200
    client.ask("subscribe")
    assert client.start(short_plan("calibrated", profile=profile))["ok"]
    assert client.wait_finished("calibrated")["outcome"] == "completed"
    assert client.status()["calibration"] is None
    old = profile | {"expires_at_utc": profile["set_at_utc"]}
    assert client.ask("start", plan=short_plan("old", profile=old))["problem"]["code"] == "refused"

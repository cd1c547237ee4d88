"""Two muscles, and an electrode array behind its switch, over the wire: what is sealed is what each electrode felt."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig import archive
from tests.harness.processes import Bench, short_plan

pytestmark = pytest.mark.wire

BICEPS = {"current_ma": 20.0, "max_pulse_width_us": 250.0, "max_torque_nm": 30.0}
TRICEPS = {"current_ma": 16.0, "max_pulse_width_us": 200.0, "max_torque_nm": 30.0}
STEPS = {"sequence": "steps", "settings": {"on_s": 0.5, "off_s": 0.25, "repeats": 2}}


def rest(duration_s: float) -> dict[str, Any]:
    return {"name": "rest", "sequence": "rest", "settings": {"duration_s": duration_s}}


def both(**of_biceps: Any) -> dict[str, Any]:
    channels = [{"name": "biceps", "profile": BICEPS, **of_biceps}, {"name": "triceps", "profile": TRICEPS}]
    return {"profile": BICEPS, "channels": channels}


def played(bench: Bench, plan: dict[str, Any]) -> dict[str, Any]:
    client = bench.start_rig()
    client.ask("subscribe")
    reply = client.start(plan)
    assert reply["ok"], reply
    return client.wait_finished(plan["test_id"], 60.0)


@pytest.mark.parametrize("stimulator", ["p24", "rehastim2"])
def test_two_muscles(make_bench: Callable[..., Bench], stimulator: str):
    bench = make_bench("--patient", "two_muscles:7", "--stimulator", stimulator, "--noise-seed", "7", speed=1.0)
    ramp = {
        "name": "both",
        "sequence": "ramp",
        "settings": {"up_s": 0.75, "down_s": 0.75},
        "channels": {"triceps": STEPS},
    }
    event = played(bench, short_plan("two", segments=[rest(0.5), ramp, rest(0.5)], **both()))
    assert event["outcome"] == "completed", event
    with h5py.File(event["recording_path"]) as file:
        assert archive.verify(event["recording_path"]) == file.attrs["content_sha256"]
        assert file.attrs["format_version"] == 2
        assert [one["name"] for one in json.loads(file.attrs["channels"])] == ["biceps", "triceps"]
        pulses = {name: np.asarray(file[f"pulses/{name}"]) for name in file["pulses"]}
        method = file["alignment"].attrs["method"]
    sent = pulses["status"] == 0
    outputs = {(0, 0): 0, (0, 1): 1}
    felt = [(outputs[tuple(p["output"])], p["width_us"], p["current_ma"]) for p in bench.felt()]
    assert felt == list(
        zip(pulses["channel"][sent], pulses["sent_pulse_width_us"][sent], pulses["current_ma"][sent], strict=True)
    )
    assert {(channel, current_ma) for channel, _, current_ma in felt} == {(0, 20.0), (1, 16.0)}
    assert min(sum(channel == one for channel, *_ in felt) for one in (0, 1)) >= 10
    written_s, acked_s = (pulses[f"{name}_time_s"][sent] for name in ("written", "acknowledged"))
    assert np.all(written_s[1:] >= acked_s[:-1]), "one on its way at most"
    assert method == "sync"
    counts = event["summary"]["channels"]
    assert {name: of["pulses"] for name, of in counts.items()} == {
        name: sum(channel == place for channel, *_ in felt) for place, name in enumerate(("biceps", "triceps"))
    }


def test_an_array_behind_its_switch(make_bench: Callable[..., Bench]):
    bench = make_bench("--array", "3", "--noise-seed", "7", speed=1.0)
    client = bench.start_rig()
    client.ask("subscribe")
    status = client.ask("status")["body"]
    assert status["switch"]["elements"] == 16
    channels = [{"name": "biceps", "profile": BICEPS, "elements": [99]}]
    plan = short_plan("array", profile=BICEPS, channels=channels)
    refused = client.start(plan)
    assert not refused["ok"]
    assert "from 1 to 16" in refused["problem"]["detail"]
    channels[0]["elements"] = [5, 6]
    assert client.start(plan)["ok"]
    event = client.wait_finished("array", 60.0)
    assert event["outcome"] == "completed", event
    with h5py.File(event["recording_path"]) as file:
        assert json.loads(file.attrs["channels"])[0]["elements"] == [5, 6]
        told = [(one["event"], one["elements"]) for one in json.loads(file.attrs["events"]) if "elements" in one]
    assert told == [("relays", [5, 6]), ("relays_set", [5, 6]), ("relays_open", [])]
    assert bench.felt()

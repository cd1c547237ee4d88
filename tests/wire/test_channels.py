"""Two muscles over the wire: what is sealed is what each electrode felt."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.identify import muscles
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


def test_both_muscles_are_identified_from_what_was_sealed(make_bench: Callable[..., Bench]):
    """The same muscles off line are the truth: the rig's pulses, times and torque must lead to them."""
    bench = make_bench("--patient", "two_muscles:7", "--noise-seed", "7", speed=1.0)

    def part(name: str, sequence: str, settings: dict[str, Any], of_triceps: dict[str, Any] | None) -> dict[str, Any]:
        own = {} if of_triceps is None else {"triceps": {"sequence": sequence, "settings": of_triceps}}
        return {"name": name, "sequence": sequence, "settings": settings, "channels": own}

    ramp = {"up_s": 1.5, "down_s": 1.5}
    segments = [
        rest(1.0),
        part("prbs", "prbs", {"chips": 50}, {"chips": 50, "seed": 40}),
        rest(1.0),
        part("ramp", "ramp", ramp, None),
        {**rest(0.1), "name": "ramp", "channels": {"triceps": {"sequence": "ramp", "settings": ramp}}},
        rest(1.0),
        part("validate", "multilevel", {"duration_s": 4.0}, {"duration_s": 4.0, "seed": 31}),
        rest(0.5),
    ]
    event = played(bench, short_plan("whole", segments=segments, **both()))
    assert event["outcome"] == "completed", event
    record = muscles.read(event["recording_path"])
    assert record.names == ("biceps", "triceps")
    assert record.channels[1].offset_s == pytest.approx(0.0125)
    model = muscles.fit(record)
    assert model.fit["held_out_fit_percent"] > 90, model.fit
    predicted = muscles.parts(model, record)
    assert predicted["biceps"].max() > 5 * abs(predicted["biceps"].min())
    assert -predicted["triceps"].min() > 5 * abs(predicted["triceps"].max())

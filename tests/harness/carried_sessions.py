"""Muscles with three hidden effects and their sessions, to see what is said of a structure that is carried over.

The records come from the emulator's physics, whose equations are not the library's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from bench.muscles.hidden_records import SLOWEST_SIMULATION_HZ, sampled
from bench.muscles.recorders import recorded
from stimrig.hardware_sim.hidden import NOISE_SD_NM
from stimrig.hardware_sim.hidden.design import make_design
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario, rng_of
from stimrig.identify.records.record import Record

LASTING = (
    "fatigue", "potentiation", "recruitment_hysteresis", "asymmetric_relaxation", "electromechanical_delay",
    "threshold_drift", "output_saturation", "activation_dependent_speed", "catch_like", "baseline_drift",
)  # fmt: skip
"""Effects that the muscle or the set-up keeps until the next session; efforts and tremor come by chance."""
SESSIONS = {"both": (0, 1), "one": (0,), "none": (), "third": (0, 1, 2)}
"""Which of a muscle's three effects a second session has."""
RATE_HZ = 200.0


def as_record(made: dict[str, Any]) -> Record:
    """A generated record as the diagnosis takes it."""
    return Record.from_arrays(
        made["time_s"],
        made["pulse_width_us"],
        made["torque_nm"],
        made["segment"],
        angle_rad=made.get("angle_rad"),
        velocity_rad_s=made.get("velocity_rad_s"),
    )


def muscle(seed: int) -> Scenario:
    """A muscle with three hidden effects."""
    for attempt in range(20):
        rng = rng_of(seed, "carried", str(attempt))
        names = tuple(str(name) for name in rng.choice(LASTING, 3, replace=False))
        try:
            return draw_scenario(names, "middle", seed)
        except ValueError:  # no muscle shows these three together
            continue
    raise ValueError(f"seed {seed}: no muscle found; take another seed")


def session(of: Scenario, seed: int, label: str, effects: tuple[int, ...]) -> Record:
    """A test of the muscle in a session of its own, with some of its effects."""
    scenario, made = _sampled(of, seed, label, effects, RATE_HZ)
    kind = "plain" if label == "first" else "real+scaled"
    made["truth"] = scenario.truth(NOISE_SD_NM)
    return as_record(recorded(made, kind, seed))


def fine_session(of: Scenario, seed: int, label: str) -> dict[str, Any]:
    """A second session of a muscle at the rate of the simulation, as no recorder has changed it."""
    return _sampled(of, seed, label, SESSIONS[label], SLOWEST_SIMULATION_HZ)[1]


def _sampled(
    of: Scenario, seed: int, label: str, effects: tuple[int, ...], rate_hz: float
) -> tuple[Scenario, dict[str, Any]]:
    design = make_design("full", rng_of(seed, "pulses", label), float(of.base.largest_width_us))
    scenario = replace(of, hidden=tuple(of.hidden[index] for index in effects), design=design)
    noise = rng_of(seed, "noise", label)
    made = sampled(scenario, design, rate_hz, lambda count: noise.normal(0.0, NOISE_SD_NM, count))
    return scenario, made

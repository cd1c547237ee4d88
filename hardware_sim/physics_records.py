"""Records of muscles of other physics, each with a second record that no fit is given.

The first is one test of 47 s at 40 pulses/s: rest, PRBS, ramp, rest, multi-level `validate`; white noise of 0.05 N·m,
in some a slow zero and hum. The second, unseen, is of the same muscle, rested: other levels, held otherwise, with its
noise-free torque. Seeds take the kinds of a set in turn. Seeds 0 to 99 are for development.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.hardware_sim.hidden.base import Base, draw_base, recruit
from stimrig.hardware_sim.hidden.chain import Chain, simulate
from stimrig.hardware_sim.hidden.design import PULSES_PER_S, Design, levels, make_design
from stimrig.hardware_sim.hidden.kernels import Floats, Stage
from stimrig.hardware_sim.hidden.physics import FURTHER, PHYSICS, Mechanism
from stimrig.hardware_sim.hidden.physics_held_back import SEALED
from stimrig.hardware_sim.hidden.scenario import rng_of

SETS: dict[str, dict[str, Mechanism]] = {"physics": PHYSICS, "further": FURTHER, "sealed": SEALED, "plain": {}}
"""Kinds of muscles; those of `plain` are of the library's own structure, and lack nothing."""
DISTURBED = {"hum": "mains_hum", "slow zero": "baseline_drift", "breath": ""}
"""What may lie over a record, and the library's name of it, where it has one."""
NOISE_SD_NM = 0.05
RATE_HZ, SIMULATION_HZ = 400, 1600
UNSEEN_S = 22.0
STRENGTH = 0.6
"""Largest torque over that of a drawn plain muscle: 1.8 to 9 N·m."""


def record_of_physics(kinds: str, seed: int, disturbed: tuple[str, ...] | None = None) -> dict[str, Any]:
    """A record, and one more of the same muscle.

    Parameters
    ----------
    kinds
        One of `SETS`.
    seed
        Decides every random number, and the kind.
    disturbed
        What of `DISTURBED` lies over the first record. None: in `plain` one of them or all in turn, otherwise hum and
        slow zero in a third of the records each.

    Returns
    -------
    dict
        `time_s`, `pulse_width_us`, `torque_nm`, `segment`, shape (n,), at 400 Hz; `unseen`, the same columns of the
        second record, whose torque has neither noise nor zero; `truth`: `kind`, `numbers`, `true` (names that are no
        mistake), `disturbed`, `noise_sd_nm`.

    Raises
    ------
    ValueError
        No such set or disturbance.
    """
    if kinds not in SETS:
        raise ValueError(f"set {kinds!r}: one of {', '.join(SETS)}")
    rng = rng_of(seed, "physics", kinds)
    base = draw_base(rng)
    names = list(SETS[kinds])
    name = names[seed % len(names)] if names else "plain"
    stages, numbers = base.stages(), {}
    if names:
        mechanism = SETS[kinds][name]
        numbers = mechanism.draw(rng, base)
        stages = _scaled(base, mechanism, tuple(numbers.values()))
    top_us = float(base.largest_width_us)
    design = make_design("full", rng, top_us)
    made = _columns(design, base, stages)
    chance = rng.random(2)
    over = disturbed if disturbed is not None else _which(kinds, seed, chance)
    made["torque_nm"] = made["torque_nm"] + rng.normal(0.0, NOISE_SD_NM, made["torque_nm"].size)
    for one in over:
        made["torque_nm"] += disturbance_nm(one, seed, made["time_s"])
    truth = {"kind": name, "seed": seed, "numbers": numbers, "disturbed": list(over), "noise_sd_nm": NOISE_SD_NM}
    truth["true"] = sorted({*(SETS[kinds][name].true if names else ()), *(DISTURBED[one] for one in over)} - {""})
    return made | {"unseen": _columns(unseen_design(seed, top_us), base, stages), "truth": truth}


def _which(kinds: str, seed: int, chance: Floats) -> tuple[str, ...]:
    if kinds == "plain":
        return (*((one,) for one in DISTURBED), tuple(DISTURBED))[seed % (len(DISTURBED) + 1)]
    return tuple(one for one, drawn in zip(("hum", "slow zero"), chance, strict=True) if drawn < 1.0 / 3.0)


def _scaled(base: Base, mechanism: Mechanism, numbers: tuple[float, ...]) -> list[Stage]:
    """Recruitment and mechanism, such that a fresh train of the largest pulses reaches this share of the largest."""
    count = 3 * SIMULATION_HZ
    width_us, pulse, still = np.full(count, float(base.largest_width_us)), np.zeros(count), np.zeros(count)
    pulse[:: SIMULATION_HZ // PULSES_PER_S] = 1.0
    stage = Stage(mechanism.kernel, (1.0, *numbers))
    chain = Chain([Stage(recruit, base.table_nm), stage], base.largest_nm, 1.0 / SIMULATION_HZ)
    most_nm = float(np.max(chain.run(width_us, pulse, still, still)))
    return [Stage(recruit, base.table_nm), replace(stage, parameters=(STRENGTH * base.largest_nm / most_nm, *numbers))]


def unseen_design(seed: int, top_us: float) -> Design:
    """Rest, random levels of 0.25 to 1.25 s with few rests, rest, slow steps near and above threshold, rest."""
    rng = rng_of(seed, "physics", "unseen")
    quick = levels(rng, top_us, 0.6 * UNSEEN_S)
    slow = np.repeat(rng.uniform(0.3, 1.0, 6) * top_us, round(0.4 * UNSEEN_S / 6 * PULSES_PER_S))
    rest = np.zeros(2 * PULSES_PER_S)
    width = np.round(np.concatenate([rest, quick, rest, slow, rest]))
    return Design(width, np.full(width.size, "validate", "U12"))


def _columns(design: Design, base: Base, stages: list[Stage]) -> dict[str, Any]:
    """The columns of the muscle's record of this design, without noise."""
    torque = simulate(base, stages, design, 1.0 / SIMULATION_HZ)[:: SIMULATION_HZ // RATE_HZ]
    repeated = RATE_HZ // PULSES_PER_S
    return {
        "time_s": np.arange(torque.size) / RATE_HZ,
        "pulse_width_us": np.repeat(design.width_us, repeated),
        "torque_nm": torque,
        "segment": np.repeat(design.segment, repeated),
    }


def disturbance_nm(kind: str, seed: int, time_s: Floats) -> Floats:
    """What lies over a record, N·m.

    `hum`: 50 or 60 Hz of 0.03 to 0.1 N·m, and its third harmonic. `slow zero`: a smooth random walk whose spread over
    the record is 0.1 to 0.3 N·m. `breath`: 0.2 to 0.35 Hz, slowly varying, of 0.05 to 0.15 N·m.
    """
    rng = rng_of(seed, "disturbed", kind)
    if kind == "hum":
        turn = 2.0 * np.pi * float(rng.choice([50.0, 60.0])) * (1.0 + 1e-4 * rng.standard_normal()) * time_s
        size, phases = float(rng.uniform(0.03, 0.1)), rng.uniform(0.0, 2.0 * np.pi, 2)
        return size * (np.sin(turn + phases[0]) + 0.3 * np.sin(3.0 * turn + phases[1]))
    seconds = np.arange(math.ceil(time_s[-1]) + 2.0)
    if kind == "slow zero":
        walk = np.cumsum(rng.standard_normal(seconds.size))
        walk = np.convolve(walk, np.hanning(9) / np.hanning(9).sum(), "same")
        walk = np.interp(time_s, seconds, walk)
        return (walk - walk[0]) * float(rng.uniform(0.1, 0.3)) / float(np.std(walk))
    if kind == "breath":
        hz = float(rng.uniform(0.2, 0.35)) * np.exp(0.08 * rng.standard_normal(seconds.size))
        size = float(rng.uniform(0.05, 0.15)) * np.exp(0.2 * rng.standard_normal(seconds.size))
        turn = np.concatenate([[0.0], np.cumsum(2.0 * np.pi * hz)])[:-1] + rng.uniform(0.0, 2.0 * np.pi)
        return np.interp(time_s, seconds, size) * np.sin(np.interp(time_s, seconds, turn))
    raise ValueError(f"disturbance {kind!r}: one of {', '.join(DISTURBED)}")

"""Records of muscles of other physics, each with a second record that no fit is given.

The first is the design `full` (47 s at 40 pulses/s: rest, PRBS, ramp, rest, multi-level `validate`) or a protocol of
the rig; white noise of 0.05 N·m, in some a slow zero and hum. The second, unseen, is of the same muscle, rested: other
levels, held otherwise, with its noise-free torque. Seeds take the kinds of a set in turn. Seeds 0 to 99 are for
development.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bench.muscles.hidden_records import sampled
from bench.muscles.other_physics import SETS, PhysicsMuscle, draw_muscle
from stimrig.hardware_sim.hidden.design import PULSES_PER_S, Design, levels, make_design
from stimrig.hardware_sim.hidden.kernels import Floats
from stimrig.hardware_sim.hidden.scenario import rng_of
from stimrig.rig import limits, plan, protocols
from stimrig.rig.messages import Profile, TestPlan

DISTURBED = {"hum": "mains_hum", "slow zero": "baseline_drift", "breath": ""}
"""Disturbances of a record, and the library's name of each, where it has one."""
FULL = "full"
TESTS = (FULL, *protocols.LIBRARY)
"""Tests of the first record."""
NOISE_SD_NM = 0.05
RATE_HZ = 400.0
UNSEEN_S = 22.0
FURTHER_SEED_OFFSET = 1_000_000
"""Added to the seed of the disturbances of a further record."""


def record_of_physics(
    kinds: str, seed: int, disturbed: tuple[str, ...] | None = None, protocol: str = FULL
) -> dict[str, Any]:
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
    protocol
        One of `TESTS`; the muscle, its disturbances and the second record are the same with each.

    Returns
    -------
    dict
        `time_s`, `pulse_width_us`, `torque_nm`, `segment`, shape (n,), at 400 Hz; `unseen`, the same columns of the
        second record, whose torque has neither noise nor zero; `truth`: `kind`, `numbers`, `true` (names that are no
        mistake), `place` (right answers to where the muscle departs from the plain structure, of `TERM_PLACES`; none
        of `plain`), `disturbed`, `noise_sd_nm`.

    Raises
    ------
    ValueError
        No such set or disturbance.
    """
    rng = rng_of(seed, "physics", kinds)
    muscle = draw_muscle(kinds, seed, rng)
    top_us = float(muscle.base.largest_width_us)
    design = make_design(FULL, rng, top_us)
    if protocol != FULL:
        design = protocol_design(protocol, top_us)
    columns = sampled(muscle, design, RATE_HZ, np.zeros)
    chance = rng.random(2)
    over = disturbed if disturbed is not None else _disturbances(kinds, seed, chance)
    columns["torque_nm"] = columns["torque_nm"] + rng.normal(0.0, NOISE_SD_NM, columns["torque_nm"].size)
    for disturbance in over:
        columns["torque_nm"] += disturbance_nm(disturbance, seed, columns["time_s"])
    truth = _truth(kinds, muscle) | {"seed": seed, "disturbed": list(over), "noise_sd_nm": NOISE_SD_NM}
    truth["true"] = sorted({*truth["true"], *(DISTURBED[disturbance] for disturbance in over)} - {""})
    return columns | {"unseen": sampled(muscle, unseen_design(seed, top_us), RATE_HZ, np.zeros), "truth": truth}


def protocol_design(protocol: str, largest_us: float) -> Design:
    """Return a protocol's pulses at the default rate, as the rig builds them."""
    profile = Profile(max_pulse_width_us=largest_us)
    request = TestPlan(test_id="bench", participant="P", profile=profile, protocol=protocol)
    test = plan.build(request, limits.for_plan(limits.HARD_LIMITS, request))
    names = np.concatenate([np.full(part.end - part.start, part.name, "<U20") for part in test.segments])
    return Design(np.floor(test.pulse_width_us), names)


def further_record(kinds: str, seed: int, over: tuple[str, ...], width_us: Floats) -> dict[str, Any]:
    """One more record of a set's muscle, rested, of pulse widths that somebody chose.

    Parameters
    ----------
    kinds, seed
        As in `record_of_physics`.
    over
        What of `DISTURBED` lies over it, as over the first record: the same hum; what has no law begins anew.
    width_us
        One for each pulse, at 40 pulses/s, shape (n,).

    Returns
    -------
    dict
        The columns of `record_of_physics`, with noise; its one segment is `further`.
    """
    design = Design(np.round(width_us), np.full(width_us.size, "further", "U12"))
    columns = sampled(draw_muscle(kinds, seed), design, RATE_HZ, np.zeros)
    rng = rng_of(seed, "physics", "further")
    columns["torque_nm"] = columns["torque_nm"] + rng.normal(0.0, NOISE_SD_NM, columns["torque_nm"].size)
    for disturbance in over:
        disturbance_seed = seed if disturbance == "hum" else seed + FURTHER_SEED_OFFSET
        columns["torque_nm"] += disturbance_nm(disturbance, disturbance_seed, columns["time_s"])
    return columns


def _truth(kinds: str, muscle: PhysicsMuscle) -> dict[str, Any]:
    """Return the right answers about the muscle alone."""
    kind = SETS[kinds].get(muscle.kind)
    right = {key: sorted(getattr(kind, key)) if kind else [] for key in ("true", "place")}
    return {"kind": muscle.kind, "numbers": muscle.numbers} | right


def _disturbances(kinds: str, seed: int, chance: Floats) -> tuple[str, ...]:
    if kinds == "plain":
        return (*((name,) for name in DISTURBED), tuple(DISTURBED))[seed % (len(DISTURBED) + 1)]
    return tuple(name for name, number in zip(("hum", "slow zero"), chance, strict=True) if number < 1.0 / 3.0)


def unseen_design(seed: int, top_us: float) -> Design:
    """Rest, random levels of 0.25 to 1.25 s with few rests, rest, slow steps near and above threshold, rest."""
    rng = rng_of(seed, "physics", "unseen")
    quick = levels(rng, top_us, 0.6 * UNSEEN_S)
    slow = np.repeat(rng.uniform(0.3, 1.0, 6) * top_us, round(0.4 * UNSEEN_S / 6 * PULSES_PER_S))
    rest = np.zeros(2 * PULSES_PER_S)
    width = np.round(np.concatenate([rest, quick, rest, slow, rest]))
    return Design(width, np.full(width.size, "validate", "U12"))


def disturbance_nm(kind: str, seed: int, time_s: Floats) -> Floats:
    """Return a disturbance of a record, N·m.

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

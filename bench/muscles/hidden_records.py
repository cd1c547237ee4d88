"""Offline records of muscles with a hidden effect, for developing and judging the diagnosis.

Seeds 0 to 99 are for development; reported figures use seeds from 1000.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.signal import lfilter

from bench.common import seed_range
from stimrig.hardware_sim import hidden
from stimrig.hardware_sim.hidden.chain import simulate
from stimrig.hardware_sim.hidden.design import UNRECORDED, Design, make_design
from stimrig.hardware_sim.hidden.kernels import Floats
from stimrig.hardware_sim.hidden.library import EFFECTS, OUTSIDERS
from stimrig.hardware_sim.hidden.scenario import draw_pair, draw_scenario, rng_of

SLOWEST_SIMULATION_HZ = 1600
NOISES = ("white", "ar1", "slow")
SLOW_SD_NM, SLOW_CORRELATION_S = 0.04, 0.075


def generate(
    effect: str | list[str] | tuple[str, ...] | None,
    strength: str = "middle",
    seed: int = 0,
    *,
    rate_hz: float = 400,
    design: str = "full",
    noise_sd_nm: float = 0.04,
    noise: str = "white",
    with_validate: bool = True,
    steep: bool = False,
    moving: bool = False,
    pulsed: bool = False,
    again_after_s: float | None = None,
) -> dict[str, Any]:
    """One record.

    Parameters
    ----------
    effect
        An id, several, or None for nothing hidden.
    strength
        `weak`, `middle` or `strong`: the best effect-free Hammerstein fit leaves an error of 2 to 5, 5 to 10, over 10
        times `noise_sd_nm` in the held-out rows of the same record without noise.
    seed
        Decides every random number.
    rate_hz
        40 to 2000; torque is point-sampled from a simulation at 1600 Hz or more.
    design
        `full` or `short` (PRBS and ramp only).
    noise
        See `draw_noise`; an autocorrelation is drawn between 0.5 and 0.99.
    steep
        Recruitment that rises from 10 to 90 % within 5 to 25 µs.
    moving
        The joint moves slowly, `angle_rad` and `velocity_rad_s` are recorded (always so where an effect needs it).
    pulsed
        Each pulse drives the muscle in a burst of 3 to 12 ms about the middle of its period, not over all of it.
    again_after_s
        After this unrecorded rest the patient does a second test of the same design: two records joined, with a jump of
        time between them.

    Returns
    -------
    dict
        `time_s`, `pulse_width_us`, `torque_nm`, `segment`, shape (n,), with `angle_rad` and `velocity_rad_s` where the
        joint moves; and `truth`.

    Raises
    ------
    ValueError
        Unknown effect, strength, noise or design; a rate out of range.
    """
    if not 40 <= rate_hz <= 2000:
        raise ValueError(f"rate {rate_hz} Hz: give 40 to 2000")
    names = () if effect is None else (effect,) if isinstance(effect, str) else tuple(effect)
    scenario = draw_scenario(
        names,
        strength if names else "middle",
        seed,
        noise_sd_nm=noise_sd_nm,
        steep=steep,
        moving=moving,
        pulsed=pulsed,
        design=design,
        with_validate=with_validate,
    )
    sequence = scenario.design
    if again_after_s is not None:
        largest_us = float(scenario.base.largest_width_us)
        second_test = make_design(design, rng_of(seed, "again"), largest_us, with_validate=with_validate)
        sequence = sequence.then(again_after_s, second_test)
    rng = rng_of(seed, "noise", *names, strength)
    rho = float(1.0 - np.exp(rng.uniform(np.log(0.01), np.log(0.5))))

    def noise_nm(count: int) -> Floats:
        return draw_noise(noise, rng, count, rate_hz, noise_sd_nm, rho)

    record = sampled(scenario, sequence, rate_hz, noise_nm)
    conditions = {"kind": noise, "sd_nm": noise_sd_nm}
    if noise == "ar1":
        conditions["rho_40hz"] = round(rho, 5)
    if noise == "slow":
        conditions |= {"slow_sd_nm": SLOW_SD_NM, "slow_correlation_s": SLOW_CORRELATION_S}
    about = {"seed": seed, "noise": conditions, "steep": steep, "design": design, "rate_hz": rate_hz}
    return record | {"truth": scenario.truth(noise_sd_nm) | about}


def _ar1(rng: Generator, count: int, sd_nm: float, rho: float) -> Floats:
    innovations = rng.normal(0.0, sd_nm * math.sqrt(1.0 - rho * rho), count)
    innovations[0] = rng.normal(0.0, sd_nm)
    return np.asarray(lfilter([1.0], [1.0, -rho], innovations))


def draw_noise(kind: str, rng: Generator, count: int, rate_hz: float, sd_nm: float, rho_40hz: float) -> Floats:
    """Sensor noise at the record's rate, N·m, shape (count,).

    `white`; `ar1`: first-order, with autocorrelation `rho_40hz` over 25 ms and standard deviation `sd_nm`; `slow`: the
    white noise and beside it noise of 0.04 N·m with a correlation time of 75 ms.

    Raises
    ------
    ValueError
        No such kind.
    """
    if kind == "white":
        return rng.normal(0.0, sd_nm, count)
    if kind == "ar1":
        return _ar1(rng, count, sd_nm, rho_40hz ** (40.0 / rate_hz))
    if kind == "slow":
        slow = _ar1(rng, count, SLOW_SD_NM, math.exp(-1.0 / (rate_hz * SLOW_CORRELATION_S)))
        return rng.normal(0.0, sd_nm, count) + slow
    raise ValueError(f"noise {kind!r}: one of {', '.join(NOISES)}")


def patient_record(seed: int) -> dict[str, Any]:
    """A record of the patient that `--hidden SEED` plays, by the design that sized it.

    White noise of 0.04 N·m, against which its strength was chosen.
    """
    scenario = hidden.draw_patient(seed, False)
    rng = rng_of(seed, "noise of a patient", "still")
    noise_nm = lambda count: rng.normal(0.0, hidden.NOISE_SD_NM, count)  # noqa: E731
    return sampled(scenario, scenario.design, 400.0, noise_nm) | {"truth": hidden.reveal(seed, False)}


def sampled(muscle: Any, design: Design, rate_hz: float, noise_nm: Callable[[int], Floats]) -> dict[str, Any]:
    """Simulate a record of this design: its columns without the unrecorded rows."""
    every = math.ceil(SLOWEST_SIMULATION_HZ / rate_hz)
    step_s = 1.0 / (rate_hz * every)
    width, _, angle, velocity = design.fine(step_s)
    count = len(range(0, width.size, every))
    fine_noise = np.zeros(width.size)
    fine_noise[::every] = noise_nm(count)
    torque = simulate(muscle.base, muscle.stages(), design, step_s, fine_noise)[::every]
    pulse_of_row = np.minimum(np.floor(np.arange(count) / rate_hz * 40 + 1e-9).astype(int), design.width_us.size - 1)
    columns: dict[str, Any] = {
        "time_s": np.arange(count) / rate_hz,
        "pulse_width_us": design.width_us[pulse_of_row],
        "torque_nm": torque,
        "segment": design.segment[pulse_of_row],
    }
    if design.movement is not None:
        columns |= {"angle_rad": angle[::every], "velocity_rad_s": velocity[::every]}
    recorded = columns["segment"] != UNRECORDED
    return {name: column[recorded] for name, column in columns.items()}


def write_csv(record: dict[str, Any], path: str | Path) -> None:
    """Write a record as `time_s,pulse_width_us,torque_nm,segment[,angle_rad,velocity_rad_s]`."""
    names = ["time_s", "pulse_width_us", "torque_nm", "segment"]
    texts = [
        np.char.mod("%.7f", record["time_s"]),
        np.char.mod("%g", record["pulse_width_us"]),
        np.char.mod("%.6f", record["torque_nm"]),
        record["segment"],
    ]
    if "angle_rad" in record:
        names += ["angle_rad", "velocity_rad_s"]
        texts += [np.char.mod("%.6f", record["angle_rad"]), np.char.mod("%.6f", record["velocity_rad_s"])]
    lines = [",".join(names), *map(",".join, zip(*texts, strict=True))]
    Path(path).write_text("\n".join(lines) + "\n")


def main(arguments: list[str] | None = None) -> int:
    """Write a set of records and `truth.json`."""
    parser = argparse.ArgumentParser(prog="python -m bench.muscles.hidden_records", description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder, made if absent")
    parser.add_argument("--seeds", type=seed_range, default=range(1), help="first:last, last not included")
    parser.add_argument(
        "--effects",
        default="all",
        help="ids with commas; a+b for two at once; 'all', 'outside', 'pairs' (by the seed), 'none' (nothing hidden)",
    )
    parser.add_argument("--strengths", default="weak,middle,strong")
    parser.add_argument("--rate-hz", type=float, default=400)
    settings = parser.parse_args(arguments)
    settings.out.mkdir(parents=True, exist_ok=True)
    effects: list[str | None] = []
    for word in settings.effects.split(","):
        effects += {"all": EFFECTS, "outside": OUTSIDERS, "none": (None,)}.get(word, (word,))
    truths = {}
    for effect in effects:
        for strength in settings.strengths.split(",") if effect else ["none"]:
            for seed in settings.seeds:
                name = f"{effect or 'none'}-{strength}-{seed}.csv"
                try:
                    drawn = list(draw_pair(rng_of(seed, "pair"))) if effect == "pairs" else effect and effect.split("+")
                    record = generate(drawn, strength, seed, rate_hz=settings.rate_hz)
                except ValueError as problem:
                    print(f"{name}: {problem}", file=sys.stderr)
                    continue
                truths[name] = record["truth"]
                write_csv(record, settings.out / name)
    (settings.out / "truth.json").write_text(json.dumps(truths, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

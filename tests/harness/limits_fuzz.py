"""Many requests at the gate, most of them invalid. No pulse outside the limits may be felt.

Widths and currents are NaN, infinite, negative, huge, tiny, at and beside every bound and every rounding step of both
stimulators. Times come too close, too late and at random. Profiles change every 500 requests. Between the gate and the
emulated stimulators' electrodes stand the real drivers and a line that sometimes stalls. Then whole plans of the same
kind: rates, currents, lists of widths, durations. This file judges, with arithmetic of its own and not the rig's, what
the electrodes felt and what an admitted plan would play.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from hardware_sim.electrodes import FiredPulse
from rig import limits, plan
from rig.errors import PlanError, RefusedError
from rig.gate import Gate
from rig.limits import HARD_LIMITS
from rig.messages import Profile, SegmentPlan, TestPlan
from rig.signals import Pulse
from tests.harness.wired_device import WiredDevice
from tests.simulator.virtual_time import VirtualMachine

MOST = {"width_us": 500.0, "current_ma": 100.0, "charge_uc": 40.0, "charge_per_s_uc": 1600.0, "pulses_per_s": 61}
"""What no table may exceed, written down here again on purpose."""
MOST_OF_A_TEST = {"duration_s": 300.0, "charge_uc": 50_000.0, "rise_us": 50.0, "rate_hz": 60.0}
STIMULATORS = {"p24": (0.5, 1), "rehastim2": (2.0, 20)}
"""What each can tell apart: steps of current in mA, shortest pulse in µs."""
BLOCK = 500


class NoJournal:
    """Takes what the gate writes and forgets it: this bench is about limits."""

    def append(self, kind: object, payload: bytes) -> None:
        """Forget."""

    def append_json(self, kind: object, content: object) -> None:
        """Forget."""


@dataclass
class Found:
    """What came of it."""

    requests: int = 0
    sent: int = 0
    felt: int = 0
    outside: int = 0
    refused_profiles: int = 0
    example: str = ""


def values(rng: np.random.Generator, n: int, most: float) -> np.ndarray:
    """Numbers around a bound, and numbers that are none."""
    mad = [
        math.nan,
        math.inf,
        -math.inf,
        -0.0,
        0.0,
        5e-324,
        -5e-324,
        1e308,
        -1e308,
        2.0**31,
        2.0**63,
        0.4999,
        0.5,
        -1.0,
    ]
    edges = [most, np.nextafter(most, np.inf), np.nextafter(most, -np.inf), most + 0.5, most - 0.5, most + 1, 2 * most]
    near = np.floor(rng.uniform(0, most, n)) + rng.choice([0.0, 0.5, 1e-9, -1e-9, 0.999999999], n)
    bits = rng.integers(0, 2**63, n, dtype=np.int64).view(np.float64)
    kinds = [rng.choice(mad, n), rng.choice(edges, n), near, bits, rng.uniform(-most, 3 * most, n), near]
    return np.choose(rng.integers(0, len(kinds), n), kinds)


def fuzz(requests: int, seed: int) -> Found:
    """Fire and judge."""
    rng = np.random.default_rng(seed)
    found = Found()
    while found.requests < requests:
        most_us, most_ma = rng.choice([500.0, 300.0, 123.4, 9999.0, math.nan]), rng.choice([100.0, 20.0, 60.5, 500.0])
        asked_us = None if rng.random() < 0.5 else float(rng.uniform(0, 600))
        profile = Profile(current_ma=most_ma, max_pulse_width_us=most_us)
        try:
            table = limits.for_plan(
                HARD_LIMITS, TestPlan(test_id="f", participant="f", profile=profile, max_pulse_width_us=asked_us)
            )
        except RefusedError:
            found.refused_profiles += 1
            found.requests += 1
            continue
        tightest = (min(most_us, 500.0, 500.0 if asked_us is None else asked_us), min(most_ma, 100.0))
        _block(rng, table, tightest, found)
    return found


def _block(
    rng: np.random.Generator, table: dict[str, limits.Limit], tightest: tuple[float, float], found: Found
) -> None:
    machine = VirtualMachine()
    clock, name = machine.clock, str(rng.choice(list(STIMULATORS)))
    device = WiredDevice(name, machine, rng)
    gate = Gate(device.driver, clock, lambda _: None, lambda _: None)
    machine.run(gate.identify())
    machine.run(gate.open(NoJournal(), table, lambda: False))  # pyright: ignore[reportArgumentType]
    widths, currents = values(rng, BLOCK, tightest[0]), values(rng, BLOCK, tightest[1])
    steady = rng.random(BLOCK) < 0.5  # half of them sane, so that doses and rates are reached
    widths[steady], currents[steady] = tightest[0] * rng.random(np.sum(steady)) ** 0.1, tightest[1]
    pauses = rng.choice([0.0, 1e-4, 0.0079, 0.008, 0.0081, 0.0125, 0.0166, 0.025, 0.5], BLOCK)
    if rng.random() < 0.5:  # steadily, or rates and doses of a second are never reached
        pauses[:] = rng.choice([0.008, 0.0125, 0.0166, 0.02, 0.025])
    for index, (width_us, current_ma, pause_s) in enumerate(zip(widths, currents, pauses, strict=True)):
        now_s = clock.now_s()
        latest_s = now_s + (-0.001 if index % 97 == 0 else 1.0)
        gate.feed()
        gate.fire(index, Pulse(float(width_us), float(current_ma)), now_s, latest_s)
        machine.wait(float(pause_s))
    machine.wait(1.0)  # what is still in the line
    found.requests += BLOCK
    found.sent += len(gate.lateness_s)
    found.felt += len(device.felt)
    if len(device.felt) != len(gate.lateness_s):
        found.outside += 1
        found.example = found.example or f"{len(gate.lateness_s)} sent, {len(device.felt)} felt"
    for words in _judge(device.felt, tightest, *STIMULATORS[name]):
        found.outside += 1
        found.example = found.example or words


def _judge(felt: list[FiredPulse], tightest: tuple[float, float], step_ma: float, shortest_us: float) -> list[str]:
    """One line for each pulse that should not have been felt."""
    wrong: list[str] = []
    for pulse in felt:
        width_us, current_ma = pulse.width_us, pulse.current_ma
        fine = 0 < width_us <= tightest[0] and 0 < current_ma <= tightest[1] and width_us * current_ma <= 40_000
        whole = float(width_us).is_integer() and float(current_ma / step_ma).is_integer()
        if not (fine and whole and width_us >= shortest_us and pulse.balanced and pulse.delivered):
            wrong.append(str(pulse))
    times = np.array([pulse.time_s for pulse in felt])
    charges_uc = np.array([pulse.width_us * pulse.current_ma * 1e-3 for pulse in felt])
    wrong += [f"{b - a} s apart" for a, b in itertools.pairwise(times) if b - a < 0.008 - 1e-9]
    first = np.searchsorted(times, times - 1.0, side="right")
    total = np.concatenate([[0.0], np.cumsum(charges_uc)])
    here = np.arange(len(times))
    wrong += ["charge per second"] * int(np.sum(total[here + 1] - total[first] > MOST["charge_per_s_uc"] + 1e-6))
    wrong += ["pulses per second"] * int(np.sum(here + 1 - first > MOST["pulses_per_s"]))
    return wrong


def fuzz_plans(plans: int, seed: int) -> Found:
    """Ask for whole tests and judge those that were admitted."""
    rng = np.random.default_rng(seed)
    found = Found()
    for _ in range(plans):
        found.requests += 1
        most_us, most_ma = rng.choice([500.0, 300.0, 123.4]), float(rng.choice([100.0, 20.0, 60.5, 500.0, math.nan]))
        rate_hz = float(rng.choice([40.0, 40.0, 20.0, 60.0, 60.0000001, 1.0, 0.999, 0.0, -40.0, math.nan, 1e9]))
        widths = _widths(rng, most_us)
        jumps = bool(rng.random() < 0.5)
        request = TestPlan(
            test_id="f", participant="f", pulse_rate_hz=rate_hz,
            profile=Profile(current_ma=most_ma, max_pulse_width_us=most_us),
            segments=[
                SegmentPlan(name="f", sequence="widths", settings={"pulse_width_us": widths.tolist(), "jumps": jumps})
            ],
        )  # fmt: skip
        try:
            test = plan.build(request, limits.for_plan(HARD_LIMITS, request))
        except (PlanError, RefusedError):
            found.refused_profiles += 1
            continue
        found.sent += 1
        if words := _judge_plan(test.pulse_width_us, most_ma, rate_hz, min(most_us, 500.0), jumps):
            found.outside += 1
            found.example = found.example or words
    return found


def _widths(rng: np.random.Generator, most_us: float) -> np.ndarray:
    """A list of widths: mostly one that might pass but for one thing."""
    kind, n = rng.integers(6), int(rng.choice([1, 5, 60, 400, 3000, 13_000], p=[0.2, 0.3, 0.25, 0.15, 0.08, 0.02]))
    if kind == 0:
        return values(rng, n, most_us)
    slope = rng.choice([1.0, 49.9, 50.0, 50.0000001, 80.0])
    ramp = np.minimum(slope * np.arange(1, n + 1), most_us * rng.random() ** 0.1)
    if kind == 1:
        ramp[rng.integers(n)] = values(rng, 1, most_us)[0]
    return ramp


def _judge_plan(widths_us: np.ndarray, current_ma: float, rate_hz: float, most_us: float, jumps: bool) -> str:
    """What is outside in a test that was admitted; empty: nothing."""
    charge_uc = widths_us * current_ma * 1e-3
    total = np.concatenate([[0.0], np.cumsum(charge_uc)])
    second = min(len(widths_us), round(rate_hz))
    rise_us = float(np.max(np.diff(widths_us, prepend=0.0)))
    wrong = {
        "width": not (np.min(widths_us) >= 0 and np.max(widths_us) <= most_us),
        "current": not (0 <= current_ma <= MOST["current_ma"]),
        "charge": not (np.max(charge_uc) <= MOST["charge_uc"]),
        "charge per second": not (np.max(total[second:] - total[:-second]) <= MOST["charge_per_s_uc"] + 1e-6),
        "rate": not (1 <= rate_hz <= MOST_OF_A_TEST["rate_hz"]),
        "duration": not (len(widths_us) / rate_hz <= MOST_OF_A_TEST["duration_s"]),
        "charge of the test": not (total[-1] <= MOST_OF_A_TEST["charge_uc"] + 1e-6),
        "rise": not jumps and not (rise_us <= MOST_OF_A_TEST["rise_us"]),
    }
    return ", ".join(name for name, is_wrong in wrong.items() if is_wrong)

"""Safety limits: ONE table, and the function that admits a pulse or says why not.

Every bound is checked as `if not (lo <= x <= hi)`, so NaN is refused. Values are rounded toward zero to the device's
steps. The tightest of table, rig file, participant's profile and request applies, and a refusal names its owner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from stimrig.rig.errors import RefusedError
from stimrig.rig.messages import PASSIVE, PULSE_RATES_HZ, Bound, Profile, TestPlan
from stimrig.rig.signals import Pulse


@dataclass(frozen=True, slots=True)
class Limit:
    """One row: the closed range that is allowed, the reason, and the source of the numbers."""

    name: str
    lo: float
    hi: float
    unit: str
    reason: str
    source: str
    owner: str = "hard limit"


HARD_LIMITS: dict[str, Limit] = {
    row.name: row
    for row in (
        Limit(
            "pulse_width_us", 0.0, 500.0, "µs",
            "longer pulses recruit pain fibres and add charge, not torque",
            "range of clinical FES stimulators (RehaStim 2: 20-500 µs); the P24 could send 4095 µs",
        ),
        Limit(
            "current_ma", 0.0, 100.0, "mA",
            "at 500 µs and 40 Hz this is 20 mA rms, below 2 mA/cm² on electrodes of 10 cm² or more",
            "IEC 60601-2-10 (attention above 2 mA/cm²); the P24 could send 130 mA",
        ),
        Limit(
            "charge_per_phase_uc", 0.0, 40.0, "µC",
            "twice what arm muscles need (300 µs × 60 mA = 18 µC); the protocol could encode 614 µC",
            "own rule, tighter than IEC 60601-2-10's 300 mJ a pulse into 500 Ω (40 µC at 100 mA: 4 mJ)",
        ),
        Limit(
            "charge_per_second_uc", 0.0, 1600.0, "µC/s",
            "40 pulses/s at the highest charge: a higher rate must use smaller pulses",
            "own rule: charge_per_phase_uc × 40 Hz",
        ),
        Limit(
            "pulse_rate_hz", *PULSE_RATES_HZ, "Hz",
            "at 40 Hz the contraction is fused; a higher rate only tires the muscle",
            "paper, section II (40 Hz); clinical FES 20-50 Hz",
        ),
        Limit(
            "pulse_interval_s", 0.008, math.inf, "s",
            "two pulses closer than this add up in the nerve; a late pulse is dropped, never sent in a burst",
            "shortest interpulse interval of the RehaStim 2 (8 ms)",
        ),
        Limit(
            "torque_nm", -60.0, 60.0, "N·m",
            "an elbow under maximal voluntary effort gives about 60 N·m: above that something is wrong",
            "own rule; the profile's max_torque_nm is normally far below",
        ),
        Limit(
            "torque_jump_nm", 0.0, 5.0, "N·m",
            "an elbow's torque cannot change so much within a sample: a knock, a loose cable, a reversed sign",
            "own rule: 1000 N·m/s, twice a strong arm's rate of rise, is 0.6 N·m a sample at 1600/s",
        ),
        Limit(
            "angle_rad", -0.35, 2.79, "rad",
            "no elbow reaches farther (20° beyond straight, 160° of flexion): the sensor or the joint is in trouble",
            "AAOS: 0 to 150°, lax joints 15° beyond straight; own margin of 5° and 10°",
        ),
        Limit(
            "angle_jump_rad", 0.0, 0.12, "rad",
            "an elbow cannot turn so far between two samples: a loose cable, a reversed sign, a slipped sensor",
            "own rule: the fastest voluntary flexion, about 20 rad/s, is 0.1 rad a sample at 200/s",
        ),
        Limit(
            "duration_s", 0.0, 300.0, "s",
            "a pre-session test must not tire the muscle before its training session",
            "own rule: a default test takes 40 s",
        ),
        Limit(
            "charge_per_test_uc", 0.0, 50_000.0, "µC",
            "ten default tests' dose (300 µs, 20 mA: about 4 mC)",
            "own rule",
        ),
        Limit(
            "width_rise_us", -math.inf, 50.0, "µs/pulse",
            "a pulse width that rises faster than 0 to 300 µs in 150 ms startles; a fall is always allowed. Sequences "
            "that jump between levels by design (such as PRBS) declare it and are exempt",
            "own rule; the paper's ramp rises by 1.5 µs a pulse",
        ),
        Limit(
            "rest_between_tests_s", 1.0, math.inf, "s",
            "from a test's last pulse to the next test's first: the torque must return to rest, or the next baseline "
            "is wrong; to avoid fatigue the rig file and the profile may ask for more",
            "paper: slowest muscle about 1 s",
        ),
        Limit(
            "rest_between_trains_s", 0.5, math.inf, "s",
            "between two trains of a calibration: a person must be able to tell them apart",
            "own rule",
        ),
        Limit(
            "calibration_step_us", 1.0, 25.0, "µs",
            "small steps: discomfort often begins only 100 µs above the sensory threshold",
            "own rule",
        ),
        Limit(
            "calibration_known_step_us", 1.0, 40.0, "µs",
            "a large step may be wider where the participant's last calibration marked more than it reaches",
            "own rule: at 20 mA 0.8 µC, within calibration_rise_uc",
        ),
        Limit(
            "calibration_rise_uc", 0.0, 1.0, "µC",
            "no train's pulses carry this much more charge than those of the train before it",
            "own rule: calibration_step_us at 40 mA; a higher current gets narrower steps",
        ),
        Limit(
            "calibration_first_uc", 0.0, 2.0, "µC",
            "the first train of a participant who is known: below what was felt last time, and never a strong pulse",
            "own rule: 100 µs at 20 mA, a usual sensory threshold",
        ),
        Limit(
            "calibration_train_s", 0.1, 2.0, "s",
            "long enough to be felt, short enough to be bearable if one step is too strong",
            "own rule",
        ),
    )
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Steps:
    """A stimulator's resolution: pulses are rounded toward zero to it; below `shortest_us` nothing is sent."""

    pulse_width_us: float = 1.0
    current_ma: float = 0.5
    shortest_us: float = 1.0

    def width_us(self, asked_us: float) -> int:
        """Width that is sent for the width asked for, µs; 0: no pulse."""
        width_us = int(int(asked_us / self.pulse_width_us) * self.pulse_width_us)
        return width_us if width_us >= self.shortest_us else 0

    def current(self, asked_ma: float) -> float:
        """Current that is sent for the current asked for, mA; 0: no pulse."""
        return int(asked_ma / self.current_ma) * self.current_ma


FINEST = Steps()


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a pulse was not admitted."""

    limit: Limit
    value: float

    def __str__(self) -> str:
        row, by = self.limit, ""
        if math.isfinite(self.value):
            above = self.value > row.hi
            by = f", over by {self.value - row.hi:g}" if above else f", under by {row.lo - self.value:g}"
        if math.isinf(row.lo):
            return f"{row.name} {self.value:g} {row.unit} is not at most {row.hi:g} ({row.owner}{by}): {row.reason}"
        if math.isinf(row.hi):
            return f"{row.name} {self.value:g} {row.unit} is not at least {row.lo:g} ({row.owner}{by}): {row.reason}"
        return (
            f"{row.name} {self.value:g} {row.unit} is outside {row.lo:g} … {row.hi:g} ({row.owner}{by}): {row.reason}"
        )


@dataclass(frozen=True, slots=True)
class Admitted:
    """A pulse that passed every limit, rounded toward zero to the device's steps.

    Made by `admit` alone; stimulators accept nothing else.
    """

    pulse_width_us: int
    current_ma: float

    @property
    def charge_uc(self) -> float:
        """Charge of one phase, µC."""
        return self.pulse_width_us * self.current_ma * 1e-3


def bounds(table: dict[str, Limit]) -> dict[str, Bound]:
    """The table for clients, so that a form can show what the rig would refuse."""
    return {
        row.name: Bound(
            lo=row.lo if math.isfinite(row.lo) else None,
            hi=row.hi if math.isfinite(row.hi) else None,
            unit=row.unit,
            owner=row.owner,
        )
        for row in table.values()
    }


def check(limit: Limit, value: float) -> Refusal | None:
    """None if `value` is within the limit, else the refusal. A NaN is refused."""
    if not (limit.lo <= value <= limit.hi):
        return Refusal(limit, value)
    return None


def refuse(limit: Limit, value: float, place: str) -> None:
    """Raise RefusedError, with its place, unless `value` is within the limit."""
    refusal = check(limit, value)
    if refusal is not None:
        raise RefusedError(f"{place}: {refusal}")


def tightened(table: dict[str, Limit], name: str, hi: float, owner: str, lo: float | None = None) -> dict[str, Limit]:
    """The table with one row's range narrowed, never widened.

    Raises RefusedError: the bound is not a number, or no value would be left.
    """
    row = table[name]
    if lo is not None and not (lo <= row.hi):
        raise RefusedError(f"{owner}: {name} {lo:g} {row.unit} must be at most {row.hi:g} {row.unit}")
    lo = row.lo if lo is None else max(row.lo, lo)
    if not (lo <= hi):
        raise RefusedError(f"{owner}: {name} {hi:g} {row.unit} must be at least {lo:g} {row.unit}")
    if hi >= row.hi and lo <= row.lo:
        return table
    return {**table, name: replace(row, lo=lo, hi=min(hi, row.hi), owner=owner)}


def at_least(table: dict[str, Limit], name: str, lo: float, owner: str) -> dict[str, Limit]:
    """The table with one row's lower bound raised, never lowered. Raises RefusedError if it is not a number."""
    return tightened(table, name, math.inf, owner, lo)


def for_profile(table: dict[str, Limit], profile: Profile, owner: str = "participant's profile") -> dict[str, Limit]:
    """The table as this participant's profile narrows it.

    Raises RefusedError: the profile holds a number that makes no sense (negative, NaN).
    """
    table = tightened(table, "pulse_width_us", profile.max_pulse_width_us, owner)
    table = tightened(table, "current_ma", profile.current_ma, owner)
    table = _for_torque(table, profile.max_torque_nm, owner)
    if profile.angle_range_rad is not None:
        lo_rad, hi_rad = profile.angle_range_rad
        table = tightened(table, "angle_rad", hi_rad, owner, lo_rad)
    if profile.rest_between_tests_s is not None:
        table = at_least(table, "rest_between_tests_s", profile.rest_between_tests_s, owner)
    return table


def _for_torque(table: dict[str, Limit], max_torque_nm: float, owner: str) -> dict[str, Limit]:
    if not (max_torque_nm > 0):
        raise RefusedError(f"{owner}: max_torque_nm {max_torque_nm:g} N·m must be above 0")
    return tightened(table, "torque_nm", max_torque_nm, owner, lo=-max_torque_nm)


def for_plan(table: dict[str, Limit], request: TestPlan) -> dict[str, Limit]:
    """The table as profile and request narrow it: of hard limit, rig file, profile and request the tightest wins.

    Raises RefusedError: a bound that makes no sense.
    """
    table = for_profile(table, request.profile)
    owner = "request"
    if request.max_pulse_width_us is not None:
        table = tightened(table, "pulse_width_us", request.max_pulse_width_us, owner)
    if request.max_torque_nm is not None:
        table = _for_torque(table, request.max_torque_nm, owner)
    if request.angle is not None:
        lo_rad, hi_rad = request.angle.range_rad
        table = tightened(table, "angle_rad", hi_rad, owner, lo_rad)
    if request.kind == PASSIVE:
        table = tightened(table, "pulse_width_us", 0.0, "passive test")
    if request.adaptive is not None:
        table = tightened(table, "duration_s", request.adaptive.max_duration_s, owner)
    return table


def admit(pulse: Pulse, table: dict[str, Limit], steps: Steps = FINEST) -> Admitted | Refusal:
    """Admit one pulse or say why not. Pure.

    Parameters
    ----------
    pulse
        Width of one phase (µs) and current (mA) as asked for.
    table
        `HARD_LIMITS`, narrowed by `tightened` and `for_profile`.
    steps
        The stimulator's.

    Returns
    -------
    Admitted
        Width (whole µs) and current in the stimulator's steps, both rounded toward zero.
    Refusal
        The first limit that the pulse breaks.
    """
    for name, value in (
        ("pulse_width_us", pulse.pulse_width_us),
        ("current_ma", pulse.current_ma),
        ("charge_per_phase_uc", pulse.charge_uc),
    ):
        refusal = check(table[name], value)
        if refusal is not None:
            return refusal
    return Admitted(steps.width_us(pulse.pulse_width_us), steps.current(pulse.current_ma))

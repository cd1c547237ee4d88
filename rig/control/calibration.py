"""Guided calibration: a person asks for short trains step by step and marks thresholds; the result is a day's profile.

This module sends nothing. It decides what the next train may be; the rig plays a train as it plays every test.

The result is valid for the day on which the calibration began. After midnight an open calibration accepts no train and
no mark, gives no profile, and says so: yesterday's thresholds must not become today's profile. A test that would end
after its profile expires is refused at its start, not cut short: the person learns the reason before anything is felt,
and the calendar never ends a train in its middle. Nothing that has begun uses the wall clock.

The rule of the steps: a step up is large until the place where the next answer is expected, and fine from there on.
Where nobody knows the participant, a large step is the widest `calibration_step_us`. Where an earlier calibration is
known, it is the wider `calibration_known_step_us`, but it never ends above what that calibration marked. A step down
goes half the way back to the next narrower train, and a step up after it goes half the way up again. No step of any
kind adds more charge to a pulse than `calibration_rise_uc`; the first train rises from nothing, and only where an
earlier calibration is known may it be more (`calibration_first_uc`).
"""

from __future__ import annotations

import itertools
from datetime import UTC, datetime, timedelta

from stimrig.rig import limits
from stimrig.rig.clock import utc_text
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import FINEST, Limit, Steps
from stimrig.rig.messages import (
    CalibrationStatus,
    CalibrationTrain,
    Direction,
    FinishedEvent,
    Profile,
    SegmentPlan,
    TestPlan,
    Threshold,
)
from stimrig.rig.requests import CalibrateStartRequest

ORDER: tuple[Threshold, ...] = ("sensory", "motor", "comfort")
STEPS: tuple[Direction, ...] = ("up", "fine", "repeat", "down")
REST_S = 0.25
"""Rest before and after each train, s: shows the torque at rest, and its fall."""
CLOCK_SLIP_S = 300.0
"""Largest lead of a profile's time over this clock, s: the clocks of two computers differ."""
MAX_VALID_S = 25 * 3600.0
"""A day, and the hour that is added when summer time ends."""
OWNER = "calibration request"

FIRST_SHARE = 0.6
"""The first train's width, as a share of the last sensory threshold: too narrow to be felt, unless much has changed."""
MOST_MISSED = 0.1
"""Share of a train's pulses that may be missing: one with more feels weaker than its width."""


class Calibration:
    """An open calibration.

    `table`: the rig's limits, hard ones narrowed by the rig file. `unix_s`: time now; its day is the day of the
    calibration. `steps`: the stimulator's resolution. Raises RefusedError: step, train, current or rate outside the
    limits, or too small to stimulate; or the current is so high that even the shortest pulse is too strong to begin
    with.
    """

    def __init__(
        self, request: CalibrateStartRequest, table: dict[str, Limit], unix_s: float, steps: Steps = FINEST
    ) -> None:
        self.request = request
        self._steps = steps
        self._ends_s = end_of_day_s(unix_s)
        for name, value in (
            ("current_ma", request.current_ma),
            ("calibration_step_us", request.step_us),
            ("calibration_train_s", request.train_s),
            ("pulse_rate_hz", request.pulse_rate_hz),
        ):
            limits.refuse(table[name], value, "calibration")
        if steps.current(request.current_ma) == 0:
            raise RefusedError(
                f"calibration: current_ma {request.current_ma:g} mA would stimulate nothing; the smallest current is "
                f"{steps.current_ma:g} mA"
            )
        if self._pulses() < 1:
            raise RefusedError(
                f"calibration: a train of {request.train_s:g} s at {request.pulse_rate_hz:g} pulses/s has no pulse; "
                "make the train longer or the rate higher"
            )
        most_us = table["pulse_width_us"].hi if request.max_pulse_width_us is None else request.max_pulse_width_us
        wanted = Profile(current_ma=request.current_ma, max_pulse_width_us=most_us, max_torque_nm=request.max_torque_nm)
        self.table = limits.for_profile(table, wanted, OWNER)
        self._set_steps()
        self._check_shortest()
        self._width_us = 0.0
        self._left_us: set[float] = set()
        self._whole = True
        """True where the last train was played as planned."""
        self._marks_us: dict[Threshold, float] = {}
        self._trains: list[CalibrationTrain] = []
        self._charge_uc = 0.0
        self.recordings: list[str] = []

    def _set_steps(self) -> None:
        """Widths of the steps, and of the first train; the current must have been checked.

        Raises RefusedError: the earlier calibration makes no sense.
        """
        request, amperes = self.request, self.request.current_ma * 1e-3
        rise_us = self.table["calibration_rise_uc"].hi / amperes
        self._fine_us = self._large_us = self._known_us = self._first_us = min(request.step_us, rise_us)
        self._last_us: dict[Threshold, float] = {}
        if not request.large_steps:
            return
        self._last_us = marks_of(request.last, request.current_ma)
        self._large_us, self._known_us = (
            max(self._fine_us, min(self.table[name].hi, rise_us))
            for name in ("calibration_step_us", "calibration_known_step_us")
        )
        self._first_us = self._large_us
        if self._last_us:
            most_us = self.table["calibration_first_uc"].hi / amperes
            self._first_us = max(self._fine_us, min(FIRST_SHARE * self._last_us["sensory"], most_us))

    def _check_shortest(self) -> None:
        """Raise RefusedError where already the stimulator's shortest pulse is more than the first train may be."""
        shortest_us, rise_uc = self._steps.shortest_us, self.table["calibration_rise_uc"].hi
        charge_uc = shortest_us * self._steps.current(self.request.current_ma) * 1e-3
        if charge_uc <= rise_uc or shortest_us <= self._first_us:
            return
        most_ma = self._steps.current(rise_uc / shortest_us * 1e3)
        raise RefusedError(
            f"calibration: at {self.request.current_ma:g} mA the stimulator's shortest pulse, {shortest_us:g} µs, is "
            f"{charge_uc:g} µC, too strong for a first train; choose {most_ma:g} mA or less"
        )

    def next_width_us(self, direction: str) -> float:
        """Width of the train that is asked for, as the stimulator sends it: the next step begins there.

        Raises RefusedError: above the limits, the request's maximum or the marked comfort maximum; names the bound and
        the excess. PlanError: there is no lower step.
        """
        ceiling = self._ceiling()
        width_us = self._asked_us(direction)
        if width_us > self._width_us:
            width_us = self._up_to(width_us, ceiling.hi)
        if self._steps.width_us(width_us) == 0:
            raise PlanError(f"calibration: no step below {self._width_us:g} µs; step up instead")
        limits.refuse(ceiling, width_us, "calibration")
        return float(self._steps.width_us(width_us))

    def check_shown(self, width_us: float, shown_us: float | None) -> None:
        """Raise PlanError if a person was shown another width than the one that would be sent now."""
        sent_us = self._steps.width_us(width_us)
        if shown_us is not None and not (shown_us == sent_us):
            raise PlanError(
                f"calibration: the page showed {shown_us:g} µs, but {sent_us} µs would be sent now; nothing was sent, "
                "look again"
            )

    def _asked_us(self, direction: str) -> float:
        """Width of the next train by the rule of the steps, before the limits."""
        width_us, fine_us, halves = self._width_us, self._fine_us, self.request.large_steps
        if direction == "up":
            if width_us == 0:
                return self._first_us
            step_us = self._step_us()
            above_us = min((w for w in self._left_us if w > width_us), default=None)
            if halves and above_us is not None:
                step_us = min(step_us, above_us - width_us, max(fine_us, (above_us - width_us) / 2))
            return width_us + step_us
        if direction == "fine":
            return width_us + fine_us if width_us else min(fine_us, self._first_us)
        if direction == "down":
            played = (train.pulse_width_us for train in self._trains if train.pulses)
            below_us = max((w for w in played if w < width_us), default=None)
            if not halves or below_us is None:
                return width_us - fine_us
            return width_us - max(fine_us, (width_us - below_us) / 2)
        return width_us

    def _step_us(self) -> float:
        """Size of a step up: large until where the next answer is expected."""
        waiting = next(iter(self._missing()), None)
        mark_us = self._last_us.get(waiting) if waiting else None
        if mark_us is None:
            return self._large_us
        goal_us = mark_us - self._fine_us if waiting == "comfort" else mark_us
        if self._width_us < goal_us:
            return min(self._known_us, max(self._fine_us, goal_us - self._width_us))
        is_near = waiting == "comfort" or self._width_us < mark_us + self._large_us
        return self._fine_us if is_near else self._large_us

    def _up_to(self, width_us: float, most_us: float) -> float:
        """A step up that ends at the highest allowed width instead of above it, and is no train of no pulses."""
        if self._width_us == 0:
            width_us = max(width_us, self._steps.shortest_us)  # below it nothing would be sent, and nothing felt
        is_wider = self._steps.width_us(most_us) > self._steps.width_us(self._width_us)
        return min(width_us, most_us) if self.request.large_steps and is_wider else width_us

    def check_day(self, unix_s: float) -> None:
        """Raise RefusedError if the day of the calibration is over."""
        if not (unix_s < self._ends_s):
            raise RefusedError(
                f"calibration: it began on an earlier day, which ended at {utc_text(self._ends_s)}; discard it and "
                "start again"
            )

    @property
    def rest(self) -> Limit:
        """Rest that the next train needs: before the first train as much as between two tests."""
        return self.table["rest_between_trains_s" if self._trains else "rest_between_tests_s"]

    def _pulses(self) -> int:
        return round(self.request.train_s * self.request.pulse_rate_hz)

    def train(self, width_us: float) -> TestPlan:
        """Plan of one train of that width. Raises RefusedError if the calibration's total charge would be too high."""
        request = self.request
        dose_uc = self._charge_uc + self._pulses() * width_us * request.current_ma * 1e-3
        limits.refuse(self.table["charge_per_test_uc"], dose_uc, "calibration, all trains together")
        rest = SegmentPlan(name="rest", sequence="rest", settings={"duration_s": REST_S})
        steps = {"max_pulse_width_us": width_us, "on_s": request.train_s, "off_s": 0.0, "repeats": 1}
        return TestPlan(
            test_id=f"{request.calibration_id}.{len(self._trains) + 1:03d}",
            participant=request.participant,
            kind="calibration",
            profile=Profile(
                current_ma=request.current_ma, max_pulse_width_us=width_us, max_torque_nm=request.max_torque_nm
            ),
            segments=[rest, SegmentPlan(name="train", sequence="steps", settings=steps), rest],
            pulse_rate_hz=request.pulse_rate_hz,
        )

    def played(self, width_us: float, torque_rise_nm: float | None, finished: FinishedEvent) -> None:
        """Record a train that has ended. One that was not felt whole moves nothing: the next step begins as before.

        A computer that stands still for a moment drops the pulses that are due by then, perhaps all of a short train.
        """
        pulses = int(finished.summary.get("pulses", 0))
        missed = int(finished.summary.get("dropped_pulses", 0))
        self._whole = pulses > 0 and not finished.summary.get("pauses") and missed <= MOST_MISSED * pulses
        if self._whole or (pulses > 0 and width_us < self._width_us):  # who steps down is never taken back up
            if width_us < self._width_us:
                self._left_us.add(self._width_us)
            self._width_us = width_us
        self._charge_uc += float(finished.summary.get("charge_uc", 0.0))
        number = len(self._trains) + 1
        self._trains.append(
            CalibrationTrain(number=number, pulse_width_us=width_us, pulses=pulses, torque_rise_nm=torque_rise_nm)
        )
        if finished.recording_path is not None:
            self.recordings.append(finished.recording_path)

    def mark(self, threshold: Threshold) -> None:
        """Mark the last train's width as that threshold.

        Raises PlanError: no train was played yet, the last one was not felt whole, or the order sensory <= motor <=
        comfort would be broken.
        """
        if not self._trains:
            raise PlanError("calibration: no train was played yet; step up first, then mark")
        if not self._whole:
            raise PlanError(
                f"calibration: train {self._trains[-1].number} was not sent whole, the computer was busy; step again, "
                "then mark"
            )
        marks: dict[Threshold, float] = {**self._marks_us, threshold: self._width_us}
        known = [(name, marks[name]) for name in ORDER if name in marks]
        for (low, low_us), (high, high_us) in itertools.pairwise(known):
            if not (low_us <= high_us):
                raise PlanError(
                    f"calibration: {low} at {low_us:g} µs is above {high} at {high_us:g} µs; mark {high} again first"
                )
        self._marks_us = marks
        self._left_us.clear()

    def profile(self, unix_s: float) -> Profile:
        """The profile, valid until the end of the day. Raises PlanError (a threshold is not marked) or RefusedError."""
        self.check_day(unix_s)
        if missing := self._missing():
            raise PlanError(f"calibration: not marked yet: {', '.join(missing)}; mark them, or finish with discard")
        return Profile(
            current_ma=self.request.current_ma,
            max_pulse_width_us=self._marks_us["comfort"],
            max_torque_nm=self.request.max_torque_nm,
            sensory_pulse_width_us=self._marks_us["sensory"],
            motor_pulse_width_us=self._marks_us["motor"],
            set_at_utc=utc_text(unix_s),
            expires_at_utc=utc_text(self._ends_s),
        )

    def status(self) -> CalibrationStatus:
        request, ceiling = self.request, self._ceiling()
        return CalibrationStatus(
            calibration_id=request.calibration_id,
            participant=request.participant,
            by=request.by,
            current_ma=request.current_ma,
            step_us=self._fine_us,
            train_s=request.train_s,
            max_torque_nm=request.max_torque_nm,
            large_steps=request.large_steps,
            last_us=dict(self._last_us),
            pulse_width_us=self._width_us,
            ceiling_us=ceiling.hi,
            ceiling_owner=ceiling.owner,
            next_us={step: width_us for step in STEPS if (width_us := self._would_send_us(step)) is not None},
            marks_us=dict(self._marks_us),
            missing=self._missing(),
            trains=list(self._trains),
        )

    def _would_send_us(self, direction: Direction) -> float | None:
        try:
            return float(self._steps.width_us(self.next_width_us(direction)))
        except (PlanError, RefusedError):
            return None

    def _missing(self) -> list[Threshold]:
        return [name for name in ORDER if name not in self._marks_us]

    def _ceiling(self) -> Limit:
        """The tightest upper bound of the width, with its owner."""
        width, phase, second = (
            self.table[n] for n in ("pulse_width_us", "charge_per_phase_uc", "charge_per_second_uc")
        )
        by_phase_us = phase.hi / (self.request.current_ma * 1e-3)
        by_second_us = second.hi / (self.request.current_ma * 1e-3 * self.request.pulse_rate_hz)
        bounds = [(width.hi, width.owner), (by_phase_us, f"{phase.owner} of {phase.name}")]
        bounds.append((by_second_us, f"{second.owner} of {second.name}"))
        if "comfort" in self._marks_us:
            bounds.append((self._marks_us["comfort"], "marked comfort maximum"))
        most_us, owner = min(bounds)
        return Limit(width.name, 0.0, most_us, width.unit, width.reason, width.source, owner)


def marks_of(last: Profile | None, current_ma: float) -> dict[Threshold, float]:
    """The marks of an earlier calibration, as far as they say something about this current.

    With a higher current every pulse is stronger than it was, so the old marks would be too high: none is used.

    Raises RefusedError: the marks are not above 0 and in their order, or the current is no number.
    """
    if last is None or last.sensory_pulse_width_us is None or last.motor_pulse_width_us is None:
        return {}
    marks: dict[Threshold, float] = {
        "sensory": last.sensory_pulse_width_us,
        "motor": last.motor_pulse_width_us,
        "comfort": last.max_pulse_width_us,
    }
    in_order = all(low <= high for low, high in itertools.pairwise((*marks.values(), float("1e4"))))
    if not (in_order and marks["sensory"] > 0 and last.current_ma > 0):
        raise RefusedError(
            "calibration: the marks of the earlier calibration are not above 0 and in the order sensory, motor, "
            "comfort; calibrate without them"
        )
    return marks if current_ma <= last.current_ma else {}


def end_of_day_s(unix_s: float) -> float:
    """Next midnight in the rig's time zone, s since 1970."""
    here = datetime.fromtimestamp(unix_s, UTC).astimezone()
    tomorrow = (here.replace(tzinfo=None) + timedelta(days=1)).replace(hour=0, minute=0, second=0, microsecond=0)
    return tomorrow.astimezone().timestamp()


def check_range(plan: TestPlan, angle_set_at_utc: str | None) -> None:
    """Raise RefusedError if a test with an angle would use a range that was said under another calibration.

    `angle_set_at_utc` is of the angle sensor's present calibration; None: it has none.
    """
    profile = plan.profile
    if plan.angle is None or profile.angle_range_rad is None or profile.angle_set_at_utc == angle_set_at_utc:
        return
    if angle_set_at_utc is None:
        raise RefusedError(
            "profile.angle_range_rad: the angle sensor has lost its calibration since; say the range again"
        )
    raise RefusedError(
        f"profile.angle_range_rad: the angle sensor was calibrated anew at {angle_set_at_utc}; say the range again"
    )


def check_profile(profile: Profile, unix_s: float, required: bool, duration_s: float = 0.0) -> None:
    """Check that a profile is consistent and still valid. Raises RefusedError, which says what is wrong with it.

    `unix_s`: time now; this is the only decision that uses UTC, since a day ends by the calendar. `required`: whether a
    profile without a calibration is refused. `duration_s`: real seconds of the test, which must end before the profile
    expires.
    """
    sensory_us, motor_us = profile.sensory_pulse_width_us, profile.motor_pulse_width_us
    thresholds = (sensory_us, motor_us, profile.set_at_utc, profile.expires_at_utc)
    if all(value is None for value in thresholds):
        if required:
            raise RefusedError("participant's profile: not calibrated; a test needs a calibration made on the same day")
        return
    if sensory_us is None or motor_us is None or profile.set_at_utc is None or profile.expires_at_utc is None:
        raise RefusedError("participant's profile: the calibration is incomplete; calibrate again")
    comfort_us = profile.max_pulse_width_us
    if not (0 < sensory_us <= motor_us <= comfort_us):
        raise RefusedError(
            f"participant's profile: sensory {sensory_us:g}, motor {motor_us:g} and comfort {comfort_us:g} µs "
            "must be above 0 and in this order; calibrate again"
        )
    set_s, expires_s = _time("set_at_utc", profile.set_at_utc), _time("expires_at_utc", profile.expires_at_utc)
    if not (set_s <= unix_s + CLOCK_SLIP_S):
        raise RefusedError(f"participant's profile: set in the future, at {profile.set_at_utc}; check the clocks")
    if not (0 < expires_s - set_s <= MAX_VALID_S):
        raise RefusedError("participant's profile: must expire within one day after it was set; calibrate again")
    if not (unix_s < expires_s):
        raise RefusedError(f"participant's profile: expired at {profile.expires_at_utc}; calibrate again")
    if not (unix_s + duration_s < expires_s):
        raise RefusedError(
            f"participant's profile: expires at {profile.expires_at_utc}, before the end of this test of "
            f"{duration_s:.0f} s; calibrate again after midnight"
        )


def _time(name: str, text: str) -> float:
    try:
        parsed = datetime.fromisoformat(text)
    except ValueError:
        raise RefusedError(f"participant's profile: {name} {text!r} is not a time in ISO 8601") from None
    if parsed.tzinfo is None:
        raise RefusedError(f"participant's profile: {name} {text!r} lacks its time zone (end it with Z)")
    return parsed.timestamp()

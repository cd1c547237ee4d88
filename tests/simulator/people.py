"""What people do at the rig: they look now and then, and do what comes to mind."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from stimrig.rig.messages import AdaptivePlan, AnglePlan, Profile, SegmentPlan, TestPlan
from stimrig.rig.requests import (
    CalibrateFinishRequest,
    CalibrateMarkRequest,
    CalibrateStartRequest,
    CalibrateStepRequest,
    CalibrateStoredRequest,
    EnoughRequest,
    ExtendRequest,
    RearmRequest,
    StartRequest,
    WithdrawRequest,
)
from tests.simulator.clinic import Asked

if TYPE_CHECKING:
    from tests.simulator.life import Life

LOOK_S = 0.25
"""On average."""
PATIENCE_S = 1.0
KEY = "a key that only its maker knows"
SEGMENTS = [
    SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 0.25}),
    SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 0.75, "down_s": 0.5}),
    SegmentPlan(name="steps", sequence="steps", settings={"on_s": 0.5, "off_s": 0.25, "repeats": 1}),
]
MORE = [SegmentPlan(name="more", sequence="steps", settings={"on_s": 0.5, "off_s": 0.25, "repeats": 1})]
LONGEST_ADAPTIVE_S = 6.0


class People:
    """One of those of a life. Once it is quiet the first only re-arms, and starts a test until one plays to its end.

    `jumping`: tests of widths that say of themselves that they jump on purpose; of all people of the life. `leads`:
    whether it is the first one; the others leave when it becomes quiet.
    """

    def __init__(self, life: Life, jumping: set[str], leads: bool = True) -> None:
        self.jumping, self.leads = jumping, leads
        self.life, self.clinic, self.chance = life, life.clinic, life.world.chance
        self.saw_one_end = False
        """Whether a test that was started in the quiet time was completed."""
        self._calibrates = self.chance.random() < 0.2
        """Whether they would rather calibrate, and to its end."""
        self._seen = ""
        """The latch that they were shown as they last looked why the rig is stopped."""
        life.world.after(LOOK_S, self._look)

    def _look(self) -> None:
        self.life.world.after(self.chance.uniform(0.02, 2 * LOOK_S), self._look)
        process, state, quiet = self.clinic.process, self.clinic.state, self.life.quiet
        if process is None or not process.alive or (quiet and not self.leads):
            return
        if self.clinic.calibrated and self.chance.random() < 0.3:
            self._take_the_result(self.clinic.calibrated)
        if state in ("latched", "uncertain", "disconnected"):
            self._rearm()
        elif state == "ready" and (quiet or self.chance.random() < 0.6):
            self._start()
        elif state == "calibrating":
            self._calibrate()
        elif quiet:
            return
        elif state == "running" and self.chance.random() < 0.15:
            self._repeat(self.clinic.stop)
        elif state == "running" and self.life.adaptive and self.chance.random() < 0.4:
            self._extend()
        elif self.chance.random() < 0.25:  # arming, stopping, sealing: in the middle of something
            self.chance.choice((self.clinic.stop, self.clinic.stop, self._start_test, self._rearm))()

    def _repeat(self, action: Callable[[], object]) -> None:
        """Most people press once."""
        for _ in range(self.chance.choice((1, 1, 2))):
            action()

    def _rearm(self) -> None:
        if self.life.quiet or self.chance.random() < 0.5:
            self._seen = self._seen or self.clinic.latch
            self._repeat(lambda: self._ask_to_rearm(self._seen))
            if not self.life.quiet and self.chance.random() < 0.1:
                self.clinic.stop()

    def _ask_to_rearm(self, seen: str) -> None:
        """Who was shown this some time before; who is refused, or obeyed, or hears nothing for long, looks again."""

        def look_again(_: object = None) -> None:
            self._seen = ""

        self.clinic.ask(RearmRequest(id=1, by="nurse", latch=seen)).then = look_again
        self.life.world.after(PATIENCE_S, look_again)

    def _start(self) -> None:
        if not self.life.quiet and self.chance.random() < (0.8 if self._calibrates else 0.1):
            self._open_calibration()
        else:
            self._repeat(self._start_test)

    def _start_test(self) -> None:
        life, quiet = self.life, self.life.quiet
        test_id = f"t{self.clinic.tests + 1}"
        profile, segments, rate_hz = life.profile, SEGMENTS, life.rate_hz
        if not quiet and self.chance.random() < 0.15:
            profile, segments, rate_hz = self._nonsense_of_a_test(test_id)
        kind, angle = "pre-session", None
        if life.arm:
            kind = "held" if life.arm == "held" else "moving"
            target_rad, still_s = (math.pi / 2, None) if kind == "held" else (None, 2.0)
            angle = AnglePlan(range_rad=(0.2, 2.4), target_rad=target_rad, still_s=still_s)
        bounds = AdaptivePlan(max_duration_s=LONGEST_ADAPTIVE_S, max_torque_time_nms=50.0)
        plan = TestPlan(
            test_id=test_id, participant="P1", kind=kind, profile=profile, pulse_rate_hz=rate_hz,
            adaptive=bounds if life.adaptive else None, angle=angle, segments=segments,
        )  # fmt: skip

        def then(asked: Asked) -> None:
            if quiet and asked.reply is not None and asked.reply.ok:
                self._await_end(test_id)

        self.clinic.tests += 1
        self.clinic.ask(StartRequest(id=self.clinic.tests, plan=plan, key=KEY), test_id).then = then
        if not quiet and self.chance.random() < 0.1:  # on its way beside the start, or at any time of the test
            delay_s, begun = self.chance.choice((0.0, 0.01, 0.3, 1.0)), self.chance.random() < 0.5
            life.world.after(delay_s, lambda: self._withdraw(test_id, begun))

    def _withdraw(self, test_id: str, begun: bool) -> None:
        process = self.clinic.process
        if process is not None and process.alive:
            self.clinic.ask(WithdrawRequest(id=1, test_id=test_id, reason="signed out", begun=begun), test_id)

    def _nonsense_of_a_test(self, test_id: str) -> tuple[Profile, list[SegmentPlan], float]:
        """What a program with a mistake asks for: a list of widths that might pass but for one number, or two."""
        most_us, chance = self.life.profile.max_pulse_width_us, self.chance
        rise_us = chance.choice((1.0, 49.9, 50.0, 50.0000001, 80.0))
        widths = [min(rise_us * number, most_us) for number in range(1, chance.choice((2, 20, 100)))]
        if chance.random() < 0.7:
            widths[chance.randrange(len(widths))] = self._nonsense(most_us)
        settings = {"pulse_width_us": widths, "jumps": chance.random() < 0.5}
        if settings["jumps"]:
            self.jumping.add(test_id)
        profile, rate_hz = self.life.profile, self.life.rate_hz
        if chance.random() < 0.3:
            field = chance.choice(("current_ma", "max_pulse_width_us", "max_torque_nm"))
            profile = profile.model_copy(update={field: chance.choice((-1.0, 0.0, 0.4, 1.0, math.nan, -math.inf))})
        if chance.random() < 0.2:
            rate_hz = chance.choice((60.0000001, 0.999, 0.0, -40.0, 1e9, math.nan))
        return profile, [SegmentPlan(name="widths", sequence="widths", settings=settings)], rate_hz

    def _nonsense(self, most: float) -> float:
        """A number at or beside a bound, or none at all."""
        beyond = most, math.nextafter(most, math.inf), most + 0.5, 2 * most, 1e308, math.inf
        return self.chance.choice((*beyond, -1.0, -0.0, 0.4999, 5e-324, -5e-324, math.nan))

    def _await_end(self, test_id: str) -> None:
        finished = next((event for event in self.clinic.finished if event.test_id == test_id), None)
        if finished is None:
            self.life.world.after(LOOK_S, lambda: self._await_end(test_id))
        elif finished.outcome == "completed":
            self.saw_one_end = True

    def _extend(self) -> None:
        rig = self.clinic.rig
        run = None if rig is None else rig.player.run
        if run is None:
            return
        test_id, after = run.plan.test_id, len(run.score.queue)
        if self.chance.random() < 0.3:
            self.clinic.ask(EnoughRequest(id=1, test_id=test_id, by="clinician"), test_id)
        else:
            more = ExtendRequest(id=1, test_id=test_id, key=KEY, after=after, segments=MORE)
            self.clinic.ask(more, test_id)

    def _open_calibration(self) -> None:
        self.clinic.tests += 1
        wild = self.chance.random() < (0.05 if self._calibrates else 0.3)
        request = CalibrateStartRequest(
            calibration_id=f"c{self.clinic.tests}", participant="P1", by="nurse",
            train_s=self._nonsense(2.0) if wild else 0.3, step_us=self._nonsense(25.0) if wild else 10.0,
            current_ma=self.life.profile.current_ma, max_pulse_width_us=self.life.profile.max_pulse_width_us,
            large_steps=self.chance.random() < 0.5,
        )  # fmt: skip
        self.clinic.ask(request, request.calibration_id)

    def _take_the_result(self, calibration_id: str) -> None:
        """It is stored; or asked for once more, as its answer was lost; or not wanted."""
        drawn = self.chance.random()
        if self.life.quiet or drawn < 0.4:
            self.clinic.ask(CalibrateStoredRequest(calibration_id=calibration_id), calibration_id)
        elif drawn < 0.9:
            self.clinic.ask(CalibrateFinishRequest(by="nurse", calibration_id=calibration_id), calibration_id)
        else:
            wanted = CalibrateFinishRequest(by="nurse", calibration_id=calibration_id, discard=True)
            self.clinic.ask(wanted, calibration_id)

    def _calibrate(self) -> None:
        drawn = self.chance.random()
        found = None if self.clinic.rig is None else self.clinic.rig.status().calibration
        if found is not None and found.trains and self._calibrates and self.chance.random() < 0.9:
            wanted = CalibrateMarkRequest(threshold=found.missing[0]) if found.missing else None
            self.clinic.ask(wanted or CalibrateFinishRequest(by="nurse"))
        elif self.life.quiet or drawn < 0.05:
            self.clinic.ask(CalibrateFinishRequest(by="nurse", discard=True))
        elif drawn < 0.6:
            direction = self.chance.choice(("up", "up", "up", "fine", "repeat", "down"))
            shown_us = self._nonsense(500.0) if self.chance.random() < 0.1 else None
            self._repeat(lambda: self.clinic.ask(CalibrateStepRequest(direction=direction, shown_us=shown_us)))
        elif drawn < 0.8:
            self.clinic.ask(CalibrateMarkRequest(threshold=self.chance.choice(("sensory", "motor", "comfort"))))
        elif drawn < 0.85:
            self.clinic.ask(CalibrateFinishRequest(by="nurse"))
        elif drawn < 0.9:
            self.clinic.stop()

"""Guided calibrations pressed in any order, on a rig whose computer and line stand still now and then.

The rig is a real one on a virtual clock. Between its gate and the emulated stimulator's electrodes stand the real
driver and its line. Steps, marks, stops, faults, lost devices, re-arming and midnight come in random order, with
numbers that are NaN, infinite, stale or absurd, and while a train is playing. This file judges what the electrodes
felt, with limits of its own.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from hardware_sim.electrodes import FiredPulse
from rig import config
from rig.acquire.health import DEFAULT_WATCH
from rig.control.rig import Rig
from rig.errors import RigError
from rig.messages import CalibrateMarkRequest, CalibrateStartRequest, CalibrateStepRequest, Profile
from rig.tasks import Task
from tests.harness.limits_fuzz import STIMULATORS, Found, values
from tests.harness.wired_device import QUICK_S, STALL_S
from tests.harness.wired_rig import BusyClock, WiredPair
from tests.simulator.disk import SimulatedDisk
from tests.simulator.virtual_time import VirtualMachine
from tests.simulator.world import World

MOST_ADDED_UC, MOST_KNOWN_FIRST_UC = 1.0, 2.0
"""What no step may add to the charge of the last train that was felt, or to none; most of a first train where an
earlier calibration is known, µC."""
MOST_US, MOST_MA, MOST_UC, MOST_STEP_US = 500.0, 100.0, 40.0, 40.0
LEAST_REST_S, LEAST_APART_S = 0.5, 0.008
LONGEST_S = 60.0
"""Within which every request is answered."""
STEPS = ("up", "up", "up", "up", "fine", "repeat", "down", "", "UP", "sideways")
MARKS = ("sensory", "motor", "comfort", "nothing")
ACTIONS = {"step": 0.66, "mark": 0.16, "pause": 0.06, "start": 0.03, "finish": 0.03, "stop": 0.02, "fault": 0.01,
           "lose": 0.01, "rearm": 0.01, "midnight": 0.01}  # fmt: skip
LINE = {"stimulator": "/dev/pts/gone", "can": {"interface": "virtual"}}


@dataclass
class Calibrated:
    """What this file remembers of the open calibration."""

    request: CalibrateStartRequest
    last_us: float = 0.0
    marked_us: float = math.inf


class Person:
    """Presses at random, and judges what was felt."""

    def __init__(self, folder: Path, rng: np.random.Generator, found: Found) -> None:
        self.rng, self.found = rng, found
        self.clock = BusyClock(rng)
        self.machine = VirtualMachine(self.clock, SimulatedDisk(World(0)))
        self.name = str(rng.choice(list(STIMULATORS)))
        self.stalls = float(rng.choice([0.0, 0.0, 0.002]))
        line = config.for_emulator(json.dumps(LINE), data_dir=folder, socket=folder / "s")
        self.rig = Rig(line, self.machine, lambda _: None)
        self.rig._watch = replace(DEFAULT_WATCH, late_pulse_periods=float(rng.choice([0.1, 0.4])))
        self.pair = WiredPair(self.name, self.machine, rng, self.stalls, self.rig)
        self.rig._pair = self.pair
        self._ask(self.rig.open())
        self._meanwhiles: list[Task[Any]] = []
        self.clock.standstills = float(rng.choice([0.0, 0.02, 0.1, 0.3]))
        self.open: Calibrated | None = None
        self.ended_s: float | None = None
        self.last_felt_s = -math.inf
        self.shown_us = math.nan
        self._numbers = itertools.count()

    def press(self, actions: int) -> None:
        """Do so many things, and judge each."""
        names, shares = list(ACTIONS), np.array(list(ACTIONS.values()))
        self._try(self._start)
        for action in self.rng.choice(names, actions, p=shares / shares.sum()):
            before, self.ended_s = len(self.pair.felt()), None
            self.found.requests += 1
            accepted = self._try(getattr(self, f"_{action}"))
            self._settle()
            felt = self.pair.felt()[before:]
            self.found.felt += len(felt)
            self.found.sent += accepted
            for words in self._judge(felt, accepted):
                self.found.outside += 1
                self.found.example = self.found.example or f"{self.name} {action}: {words}"
            if self.rig.status().calibration is None:
                self.open = None
            if self.open is None and self.rng.random() < 0.7:
                self._try(self._rearm)
                self._try(self._start)
        self._ask(self.rig.close())

    def _ask(self, request: Coroutine[Any, Any, Any]) -> Any:
        return self.machine.run(request, LONGEST_S)

    def _try(self, act: Callable[[], Any]) -> bool:
        """Whether a train was let through."""
        try:
            return act() is not None
        except (RigError, ValidationError):
            return False

    def _settle(self) -> None:
        """Until the train has ended and the line is empty."""
        playing = self.rig._playing
        if playing is not None:
            self._ask(self.machine.tasks.join(playing))
        meanwhiles, self._meanwhiles = self._meanwhiles, []
        for task in meanwhiles:
            self._try(lambda task=task: self._ask(self.machine.tasks.join(task)))
        standstills, self.clock.standstills = self.clock.standstills, 0.0
        if self.stalls:
            self.machine.wait(2 * STALL_S)
        self.clock.standstills = standstills

    # ---- what a person and the world do; not None: a train was let through ------------------------------------

    def _start(self) -> None:
        sane = self.rng.random() < 0.8
        marks = np.sort(self.rng.uniform(5, 500, 3)) if sane else values(self.rng, 3, 500.0)
        last = Profile(
            current_ma=self._number(100.0), max_pulse_width_us=marks[2],
            sensory_pulse_width_us=marks[0], motor_pulse_width_us=marks[1],
        )  # fmt: skip
        request = CalibrateStartRequest(
            calibration_id=f"c{next(self._numbers)}", participant="P", by="f",
            current_ma=self._number(100.0), step_us=self._number(25.0),
            train_s=float(self.rng.choice([0.1, 0.1, 0.2, 0.5, 2.0])) if sane else self._number(2.0),
            pulse_rate_hz=float(self.rng.choice([20.0, 40.0, 60.0])) if sane else self._number(60.0),
            max_pulse_width_us=None if self.rng.random() < 0.5 else self._number(500.0),
            large_steps=bool(self.rng.random() < 0.8), last=last if self.rng.random() < 0.6 else None,
        )  # fmt: skip
        try:
            self._ask(self.rig.calibrate(request))
        except (RigError, ValidationError):
            self.found.refused_profiles += 1
            raise
        self.open = Calibrated(request)

    def _number(self, most: float) -> float:
        if self.rng.random() < 0.05:
            return float(values(self.rng, 1, most)[0])
        return float(self.rng.uniform(0.02 * most, most))

    def _step(self) -> bool:
        told = self.rig.status().calibration
        direction = str(self.rng.choice(STEPS))
        right_us = told.next_us.get(direction, math.nan) if told else math.nan  # pyright: ignore[reportArgumentType]
        shown = self.rng.choice(5, p=[0.55, 0.35, 0.04, 0.03, 0.03])
        shown_us = [None, right_us, self.shown_us, float(values(self.rng, 1, 500.0)[0]), math.nan][shown]
        self.shown_us = right_us
        if shown == 1 and math.isnan(right_us):
            shown_us = None
        if self.rng.random() < 0.12:
            self._meanwhile()
        request = CalibrateStepRequest(direction=direction, shown_us=shown_us)  # pyright: ignore[reportArgumentType]
        self._ask(self.rig.calibrate_step(request.direction, request.shown_us))
        return True

    def _meanwhile(self) -> None:
        """Something that happens while the next train plays, or before it."""
        at_s = self.clock.now_s() + self.rng.uniform(0.0, 1.2)
        what = self.rng.choice(["again", "mark", "finish", "stop", "fault", "lose"], p=[0.25, 0.2, 0.1, 0.2, 0.2, 0.05])
        acts: dict[str, Callable[[], Any]] = {
            "again": lambda: self._begin(self.rig.calibrate_step("up")),
            "mark": lambda: self._begin(self.rig.calibrate_mark("comfort")),
            "finish": lambda: self._begin(self.rig.calibrate_finish("f", True)),
            "stop": lambda: self._ends(lambda: self._begin(self.rig.stop("ouch", "f"))),
            "fault": lambda: self._ends(lambda: self.rig._fault("something is wrong")),
            "lose": lambda: self._ends(self.pair.lose),
        }

        def act() -> None:
            # only while the train plays: afterwards the person comes first again
            if self.rig._trial.state in ("arming", "running"):
                acts[str(what)]()

        self.clock.call_at(at_s, act)

    def _ends(self, how: Callable[[], Any]) -> None:
        self.ended_s = self.clock.now_s()
        how()

    def _begin(self, request: Coroutine[Any, Any, Any]) -> None:
        """A request of somebody else, as it comes."""
        self._meanwhiles.append(self.machine.tasks.begin(request, "meanwhile"))

    def _mark(self) -> None:
        threshold = str(self.rng.choice(MARKS))
        request = CalibrateMarkRequest(threshold=threshold)  # pyright: ignore[reportArgumentType]
        self._ask(self.rig.calibrate_mark(request.threshold))
        if threshold == "comfort" and self.open is not None:
            self.open.marked_us = self.open.last_us

    def _pause(self) -> None:
        self.machine.wait(self.rng.uniform(0.0, 3.0))

    def _finish(self) -> None:
        self._ask(self.rig.calibrate_finish("f", bool(self.rng.random() < 0.5)))

    def _stop(self) -> None:
        self.ended_s = self.clock.now_s()
        self._ask(self.rig.stop("enough", "f"))

    def _fault(self) -> None:
        self.ended_s = self.clock.now_s()
        self.rig._fault("something is wrong")

    def _lose(self) -> None:
        self.ended_s = self.clock.now_s()
        self.pair.lose()

    def _rearm(self) -> None:
        self._ask(self.rig.rearm("f"))

    def _midnight(self) -> None:
        self.clock.set_unix_ahead(86_400.0)

    # ---- what the electrodes felt -------------------------------------------------------------------------------

    def _judge(self, felt: list[tuple[float, FiredPulse]], accepted: bool) -> list[str]:
        if not felt:
            return []
        if not accepted or self.open is None:
            return [f"{len(felt)} pulses felt without a train"]
        wrong = [*self._judge_width(felt), *self._judge_times([time_s for time_s, _ in felt])]
        self.open.last_us, self.last_felt_s = felt[-1][1].width_us, felt[-1][0]
        return wrong

    def _judge_width(self, felt: list[tuple[float, FiredPulse]]) -> list[str]:
        assert self.open is not None
        request, pulse, wrong = self.open.request, felt[0][1], []
        if any((p.width_us, p.current_ma) != (pulse.width_us, pulse.current_ma) for _, p in felt):
            wrong.append("two strengths in one train")
        if not all(p.balanced and p.delivered for _, p in felt):
            wrong.append("a pulse that is not balanced or not delivered")
        width_us, current_ma = pulse.width_us, pulse.current_ma
        most_us = min(MOST_US, request.max_pulse_width_us or MOST_US, self.open.marked_us)
        if not (0 < width_us <= most_us and 0 < current_ma <= min(MOST_MA, request.current_ma)):
            wrong.append(f"{width_us} µs, {current_ma} mA, at most {most_us} µs")
        charge_uc, last_us = width_us * current_ma * 1e-3, self.open.last_us
        is_known = request.large_steps and request.last is not None
        most_uc = last_us * current_ma * 1e-3 + MOST_ADDED_UC
        if not last_us and is_known:
            most_uc = MOST_KNOWN_FIRST_UC
        if not (charge_uc <= min(MOST_UC, most_uc) + 1e-9) or (last_us and not (width_us - last_us <= MOST_STEP_US)):
            wrong.append(f"{width_us} µs after {last_us} µs at {current_ma} mA")
        if len(felt) > round(request.train_s * request.pulse_rate_hz):
            wrong.append(f"{len(felt)} pulses in a train")
        return wrong

    def _judge_times(self, times_s: list[float]) -> list[str]:
        """Also of a line that stands still, which may hold one pulse; not so its rests, which it shortens."""
        wrong = [f"{b - a} s apart" for a, b in itertools.pairwise(times_s) if b - a < LEAST_APART_S - 1e-9]
        rest_s = times_s[0] - self.last_felt_s
        if not self.stalls and rest_s < LEAST_REST_S - 2 * QUICK_S:
            wrong.append(f"{rest_s} s after the last train")
        if self.ended_s is not None:
            after = [time_s for time_s in times_s if time_s > self.ended_s + QUICK_S]
            if len(after) > (1 if self.stalls else 0) or any(t > self.ended_s + STALL_S for t in after):
                wrong.append(f"{len(after)} pulses after the end")
        return wrong


def fuzz_calibrations(calibrations: int, seed: int, actions: int = 60) -> Found:
    """Press and judge: `requests` actions, of which `sent` trains were let through; `felt` pulses."""
    found = Found()
    for number in range(calibrations):
        rng = np.random.default_rng([seed, number])
        Person(Path("data"), rng, found).press(actions)
    return found

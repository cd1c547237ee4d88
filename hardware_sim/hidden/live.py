"""The hidden muscle in real time: single pulses in, torque out."""

from __future__ import annotations

import math
from typing import Any

from stimrig.hardware_sim.hidden.chain import TRAIN_GAP_S, Chain, split
from stimrig.hardware_sim.hidden.scenario import Scenario

STEPS_PER_S = 1600.0
PERIOD_STEPS = 0.025 * STEPS_PER_S
LATE_STEPS = 0.005 * STEPS_PER_S
NOMINAL_CURRENT_MA = 20.0
REMEMBERED_STEPS = 64
"""More than the latest pulse can go back: 5 ms and a delivery."""


class HiddenMuscle:
    """A muscle made of stages; it implements the `Muscle` protocol. Its joint is still unless a limb tells it.

    A pulse's width is held for 25 ms. Jitter leaves gaps between two holds; a gap of up to 5 ms is closed by going back
    to its beginning. A longer one stays: the pulse after it is late, and acts for its 25 ms besides the next one, as
    two twitches add up. Another current than 20 mA scales the width by charge.
    """

    def __init__(self, scenario: Scenario) -> None:
        before, after = split(scenario.stages())
        largest_nm = scenario.base.largest_nm
        self._muscle = Chain(before, largest_nm, 1.0 / STEPS_PER_S)
        self._converter = Chain(after, largest_nm, 1.0 / STEPS_PER_S) if after else None
        self._done = 0  # steps simulated; the state is that at `_done` / STEPS_PER_S
        self._values = (0.0, 0.0)  # torque at the last two steps
        self._edges: list[tuple[float, float]] = []  # coming changes of the width: time in steps, new width
        self._width_us = 0.0
        self._arrivals: list[float] = []
        self._hold_end = -math.inf
        self._late = 0.0  # of the last pulse, in steps, where a gap before it stays open
        self._lingering: list[tuple[float, float, float]] = []  # begin and end in steps, what a late pulse recruits
        self._at_hold_end: tuple[Any, int, tuple[float, float], float] | None = None
        self._joint = (0.0, 0.0)
        self._joints = [self._joint] * REMEMBERED_STEPS  # by step, for going back; known up to and with `_joints_known`
        self._joints_known = 0

    def joint(self, angle_rad: float, velocity_rad_s: float) -> None:
        """The joint's angle and velocity in the steps that were not simulated yet."""
        self._joint = (angle_rad, velocity_rad_s)

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        at = time_s * STEPS_PER_S
        width = width_us * current_ma / NOMINAL_CURRENT_MA
        self._run_to(math.floor(at + 1e-6))
        gap = at - self._hold_end
        if gap < 0.0:
            self._linger(at, min(-gap, self._late))
        else:
            late = (self._late + gap) % PERIOD_STEPS  # a multiple of the period is a pulse that was left out
            if gap > TRAIN_GAP_S * STEPS_PER_S or late > PERIOD_STEPS - LATE_STEPS:
                self._late = 0.0
            elif gap > LATE_STEPS:
                self._late = late
            if 0.0 < gap <= LATE_STEPS:
                self._close_gap(at)
        self._at_hold_end = None
        self._edges = [edge for edge in self._edges if edge[0] < at]
        self._edges += [(at, width), (at + PERIOD_STEPS, 0.0)]
        if width > 0.0:
            self._arrivals.append(at)
        self._hold_end = at + PERIOD_STEPS

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and return the torque on the load cell, N·m, without noise and converter."""
        at = time_s * STEPS_PER_S
        self._run_to(math.floor(at + 1e-6))
        before, last = self._values
        return last + (last - before) * (at - self._done) if at > self._done + 1e-6 else last

    def converted_nm(self, reading_nm: float, time_s: float) -> float:
        """The reading, noise included, after the converter; clipping and steps come after the noise."""
        return self._converter.step(reading_nm, 0.0, time_s * STEPS_PER_S) if self._converter else reading_nm

    def _close_gap(self, at: float) -> None:
        """Hold the last width up to `at`, although its hold had ended."""
        if self._at_hold_end is None:  # the step in which the hold ends was not simulated yet
            self._edges = [edge for edge in self._edges if edge[0] != self._hold_end]
            return
        saved, done, values, width = self._at_hold_end
        reached = self._done
        self._muscle.restore(saved)
        self._done, self._values, self._width_us = done, values, width
        self._edges = [(at, 0.0)]
        self._at_hold_end = None
        self._run_to(reached)

    def _linger(self, at: float, steps: float) -> None:
        """Let the last pulse, cut at `at`, act on for these steps besides the new one.

        It begins after the step of the new pulse: from that one a muscle takes what the new pulse alone recruits.
        """
        self._late -= steps
        begin = math.ceil(at - 1e-6) + 1.0
        self._lingering = [pulse for pulse in self._lingering if pulse[1] > self._done - REMEMBERED_STEPS]
        self._lingering.append((begin, begin + steps, self._muscle.recruited))

    def _run_to(self, step: int) -> None:
        while self._done < step:
            width, pulse = self._input()
            self._done += 1
            now = float(self._done)
            more = sum(what * max(min(end, now) - max(begin, now - 1.0), 0.0) for begin, end, what in self._lingering)
            torque_nm = self._muscle.step(width, pulse, now, self._joint_at(self._done), more)
            self._values = (self._values[1], torque_nm)

    def _joint_at(self, step: int) -> tuple[float, float]:
        """The joint at a step; a step that is simulated again finds what it had."""
        if step > self._joints_known:
            self._joints_known = step
            self._joints[step % REMEMBERED_STEPS] = self._joint
        return self._joints[step % REMEMBERED_STEPS]

    def _input(self) -> tuple[float, float]:
        """Mean width over the next step, and whether it is the first that a pulse drives from beginning to end.

        What a pulse recruits is taken from that step's width by muscles that keep it until the next pulse.
        """
        start, end = float(self._done), self._done + 1.0
        pulse = 0.0
        if self._arrivals and self._arrivals[0] <= start + 1e-6:
            self._arrivals.pop(0)
            pulse = 1.0
        if not self._edges or self._edges[0][0] >= end:
            return self._width_us, pulse
        mean, since = 0.0, start
        while self._edges and self._edges[0][0] < end:
            at, width = self._edges.pop(0)
            if at == self._hold_end:
                self._at_hold_end = (self._muscle.save(), self._done, self._values, self._width_us)
            mean += self._width_us * max(at - since, 0.0)
            since, self._width_us = max(at, start), width
        return mean + self._width_us * (end - since), pulse

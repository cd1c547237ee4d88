"""A joint of two muscles in real time: single pulses of two electrodes in, torque out."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from stimrig.hardware_sim.hidden.chain import TRAIN_GAP_S
from stimrig.hardware_sim.hidden.kernels import Floats
from stimrig.hardware_sim.joint.muscles import HOLD_S, NOMINAL_CURRENT_MA, STATES, STEPS_PER_S, Joint, run

HOLD = HOLD_S * STEPS_PER_S
LATE = 0.005 * STEPS_PER_S
REMEMBERED = 64
"""Steps that the joint can go back; more than the latest pulse needs, with a delivery."""


@dataclass
class _Held:
    """A width at 20 mA, held from `begin` to `end`, in steps."""

    begin: float
    end: float
    width_us: float


@dataclass
class Electrode:
    """One pair on the joint; it implements the `Muscle` protocol, its torque that of the joint."""

    joint: LiveJoint
    held: list[_Held] = field(default_factory=list)
    late: float = 0.0  # of the last pulse, where a gap before it stays open

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches this pair at `time_s`."""
        self.joint.take(self, time_s * STEPS_PER_S, width_us * current_ma / NOMINAL_CURRENT_MA)

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and return the joint's torque."""
        return self.joint.torque_nm(time_s)

    def width_us(self, at: float) -> float:
        """What is held at this time, in steps."""
        return next((one.width_us for one in reversed(self.held) if one.begin <= at < one.end), 0.0)


class LiveJoint:
    """A joint; its muscles rest. It is stepped at 1600 Hz.

    A pulse is held for 25 ms. Jitter leaves gaps between two holds of an electrode; a gap of up to 5 ms is closed by
    going back to its beginning. A longer one stays: the pulse after it is late, and acts for its 25 ms besides the next
    one of its electrode, as two twitches add up. Another current than 20 mA scales the width by charge.
    """

    def __init__(self, joint: Joint) -> None:
        self.joint = joint
        self.electrodes = Electrode(self), Electrode(self)
        self._state, self._done = np.zeros((2, STATES)), 0
        self._out = np.zeros((2, 3))  # of the last two steps
        run(np.zeros((0, 2)), joint.parameters, self._state, self._out)  # compiled now, not in the first step
        self._kept: deque[tuple[Floats, Floats]] = deque([(self._state.copy(), self._out.copy())], REMEMBERED)
        self._lingering: list[tuple[float, float, Floats]] = []  # begin, end, N·m of each muscle
        self._active: dict[tuple[float, float], Floats] = {}
        self._steady: tuple[float, float, Floats] = (0.0, 0.0, np.zeros(2))  # N·m of both, from and until a step

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse at the agonist's electrodes."""
        self.electrodes[0].pulse(time_s, width_us, current_ma)

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and return the torque on the load cell, N·m, without noise."""
        at = time_s * STEPS_PER_S
        self._run_to(math.floor(at + 1e-6))
        before, last = self._out[0, 2], self._out[1, 2]
        return float(last + (last - before) * (at - self._done) if at > self._done + 1e-6 else last)

    def take(self, electrode: Electrode, at: float, width_us: float) -> None:
        """A pulse of this width at 20 mA, at a time in steps."""
        self._run_to(math.floor(at + 1e-6))
        self._steady = 0.0, 0.0, np.zeros(2)
        last = electrode.held[-1] if electrode.held else _Held(-math.inf, -math.inf, 0.0)
        gap = at - last.end
        if gap < 0.0:
            self._linger(electrode, at, min(-gap, electrode.late), last.width_us)
            last.end = at
        else:
            late = (electrode.late + gap) % HOLD if gap < math.inf else 0.0  # a whole hold is a pulse left out
            if gap > TRAIN_GAP_S * STEPS_PER_S or late > HOLD - LATE:
                electrode.late = 0.0
            elif gap > LATE:
                electrode.late = late
            if 0.0 < gap <= LATE:
                self._close_gap(last, at)
        electrode.held = [one for one in electrode.held if one.end > self._done - REMEMBERED]
        electrode.held.append(_Held(at, at + HOLD, width_us))

    def _close_gap(self, last: _Held, at: float) -> None:
        """Hold the last width up to `at`, although its hold had ended."""
        reached, back = self._done, math.floor(last.end)
        last.end = at
        for _ in range(reached - back):
            self._kept.pop()
        self._state, self._out = (one.copy() for one in self._kept[-1])
        self._done = back
        self._run_to(reached)

    def _linger(self, electrode: Electrode, at: float, steps: float, width_us: float) -> None:
        """Let the last pulse, cut at `at`, act on for these steps besides the new one."""
        electrode.late -= steps
        self._lingering = [one for one in self._lingering if one[1] > self._done - REMEMBERED]
        widths = (width_us, 0.0) if electrode is self.electrodes[0] else (0.0, width_us)
        self._lingering.append((at, at + steps, self._active_nm(widths)))

    def _run_to(self, step: int) -> None:
        while self._done < step:
            active = self._mean_active_nm(float(self._done))[None]
            self._out[0] = self._out[1]
            run(active, self.joint.parameters, self._state, self._out[1:])
            self._done += 1
            self._kept.append((self._state.copy(), self._out.copy()))

    def _mean_active_nm(self, begin: float) -> Floats:
        """What both muscles' units give over the step from `begin`, in the mean."""
        end = begin + 1.0
        if self._steady[0] <= begin and end <= self._steady[1]:
            return self._steady[2]
        edges = {edge for one in self.electrodes for held in one.held[-3:] for edge in (held.begin, held.end)}
        times = [begin, *sorted(edge for edge in edges if begin < edge < end), end]
        mean_nm = np.zeros(2)
        for start, stop in pairwise(times):
            first, second = (one.width_us(start) for one in self.electrodes)
            mean_nm += (stop - start) * self._active_nm((first, second))
        if len(times) == 2 and not any(one[1] > begin for one in self._lingering):
            self._steady = begin, min((edge for edge in edges if edge > begin), default=math.inf), mean_nm
        for start, stop, more_nm in self._lingering:
            mean_nm += max(min(stop, end) - max(start, begin), 0.0) * more_nm
        return mean_nm

    def _active_nm(self, widths_us: tuple[float, float]) -> Floats:
        if widths_us not in self._active:
            if len(self._active) > REMEMBERED:
                self._active.clear()
            self._active[widths_us] = self.joint.active_nm(np.array([widths_us]))[0]
        return self._active[widths_us]

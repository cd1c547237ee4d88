"""Movers that hold or move the forearm, by name, made with settings of the control line or a file."""

from __future__ import annotations

import bisect
import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from stimrig.hardware_sim.arm.motion import (
    Begin,
    Drive,
    Leg,
    Motion,
    Path,
    Quintic,
    Servo,
    lasting_s,
    radians,
    radians_per_s,
    within,
)
from stimrig.hardware_sim.errors import ArmError

HAND_HZ = 3.0
PIECES = 5
"""A hand's sweep is made of so many pieces, each at its own speed."""
STOPS_WITHIN_S = 0.3


class Mover:
    """Holds the forearm, moves it, or lets it go.

    Its constructor takes `Begin` and, by keyword, settings with defaults, which the control line and files set.
    """

    holds_forearm = True
    """True where the forearm is held, so that the load cell in between carries the torque."""

    _at: Callable[[float], Motion]

    def at(self, time_s: float) -> Motion:
        """The motion at a time."""
        return self._at(time_s)

    def advance(self, time_s: float, drive: Drive) -> Motion:  # noqa: ARG002
        """The motion at `time_s`, which never runs backwards; only a mover that does not hold asks the drive."""
        return self.at(time_s)


class Free(Mover):
    """Nobody holds the forearm: it moves by its muscle, its tissue and gravity. Fourth-order Runge-Kutta."""

    holds_forearm = False

    def __init__(self, begin: Begin) -> None:
        self._time_s, self._motion = begin.time_s, begin.motion

    def advance(self, time_s: float, drive: Drive) -> Motion:
        """The motion at `time_s`; the limb takes short steps."""
        h = time_s - self._time_s
        if h > 0.0:
            x, v, _ = self._motion
            a1 = drive(x, v)
            v2 = v + 0.5 * h * a1
            a2 = drive(x + 0.5 * h * v, v2)
            v3 = v + 0.5 * h * a2
            a3 = drive(x + 0.5 * h * v2, v3)
            v4 = v + h * a3
            a4 = drive(x + h * v3, v4)
            x += h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
            v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            self._time_s, self._motion = time_s, Motion(float(x), float(v), float(drive(x, v)))
        return self._motion


class Fixture(Mover):
    """A fixture holds it still at `angle_deg` (where it is, if none is given).

    It is brought there smoothly with a peak speed of `deg_s`, as nobody jerks an arm.
    """

    def __init__(self, begin: Begin, angle_deg: float | None = None, deg_s: float = 60.0) -> None:
        start = begin.motion
        target_rad = start.angle_rad if angle_deg is None else radians("angle_deg", angle_deg)
        peak_rad_s = radians_per_s("deg_s", deg_s)
        if angle_deg is None and start.velocity_rad_s:  # it cannot stop on the spot
            target_rad += math.copysign(0.02, start.velocity_rad_s)
        lasts_s = lasting_s(start.angle_rad, target_rad, peak_rad_s)
        self._at = Quintic(begin.time_s, lasts_s, start, Motion(target_rad)).at


class Robot(Mover):
    """A robot sweeps the forearm between `from_deg` and `to_deg` at `deg_s`, with a rest of `pause_s` at both.

    Its own second-order dynamics lie behind the reference, and a velocity limit. It goes to `from_deg` first.
    """

    def __init__(
        self,
        begin: Begin,
        from_deg: float = 30.0,
        to_deg: float = 120.0,
        deg_s: float = 30.0,
        pause_s: float = 0.5,
        bandwidth_hz: float = 2.5,
        damping: float = 0.9,
        limit_deg_s: float = 180.0,
    ) -> None:
        ends_rad = radians("from_deg", from_deg), radians("to_deg", to_deg)
        rad_s = radians_per_s("deg_s", deg_s)
        rest_s = within("pause_s", pause_s, 0.0, 3600.0)

        def legs() -> Iterator[Leg]:
            while True:
                for end_rad in ends_rad:
                    yield Leg(end_rad, rad_s, rest_s)

        self._at = Servo(
            begin,
            Path(begin.time_s, begin.motion.angle_rad, legs()).at,
            within("bandwidth_hz", bandwidth_hz, 0.2, 30.0),
            within("damping", damping, 0.3, 3.0),
            radians_per_s("limit_deg_s", limit_deg_s),
        ).at


class Hand(Mover):
    """A therapist's hand sweeps between `from_deg` and `to_deg` at about `deg_s`; with one of them, or none, it holds.

    It is not quite steady: each sweep has a speed, a turning point and a pause of its own; the speed within it goes up
    and down. It wanders by slow waves (0.1 to 0.6 Hz) and trembles at 8 to 12 Hz (physiological tremor), so little
    that the cell feels some mN·m of the forearm's inertia. `unsteady` scales everything that is random about it; 0 is
    a steady hand.
    """

    def __init__(
        self,
        begin: Begin,
        from_deg: float | None = None,
        to_deg: float | None = None,
        deg_s: float = 30.0,
        pause_s: float = 0.6,
        wander_deg: float = 0.6,
        tremor_deg: float = 0.003,
        unsteady: float = 1.0,
    ) -> None:
        rng = np.random.default_rng([begin.seed, 0xA4D])
        first_rad = begin.motion.angle_rad if from_deg is None else radians("from_deg", from_deg)
        last_rad = first_rad if to_deg is None else radians("to_deg", to_deg)
        rad_s = radians_per_s("deg_s", deg_s)
        pause_s = within("pause_s", pause_s, 0.0, 3600.0)
        uneven = within("unsteady", unsteady, 0.0, 3.0)
        legs = _uneven_legs(rng, begin.motion.angle_rad, (first_rad, last_rad), rad_s, pause_s, uneven)
        path = Path(begin.time_s, begin.motion.angle_rad, legs)
        wander_rad = uneven * radians("wander_deg", wander_deg, 0.0, 10.0)
        tremor_rad = uneven * radians("tremor_deg", tremor_deg, 0.0, 1.0)
        waves = [*_wander(rng, wander_rad), *_tremor(rng, tremor_rad)]

        def reference_rad(time_s: float) -> float:
            since_s = time_s - begin.time_s
            return path.at(time_s) + sum(a * math.sin(w * since_s + phase) for a, w, phase in waves)

        self._at = Servo(begin, reference_rad, HAND_HZ).at


def _uneven_legs(
    rng: np.random.Generator, at_rad: float, ends_rad: tuple[float, float], rad_s: float, pause_s: float, uneven: float
) -> Iterator[Leg]:
    while True:
        for end_rad in ends_rad:
            miss_rad = uneven * math.radians(2.0) * float(rng.standard_normal())
            goal_rad = end_rad + (miss_rad if ends_rad[0] != ends_rad[1] else 0.0)
            speed = rad_s * math.exp(0.15 * uneven * float(rng.standard_normal()))
            way_rad = (goal_rad - at_rad) / PIECES
            for piece in range(1, PIECES + 1):
                leg_speed = speed * math.exp(0.12 * uneven * float(rng.standard_normal()))
                rest_s = pause_s * math.exp(0.5 * uneven * float(rng.standard_normal())) if piece == PIECES else 0.0
                yield Leg(at_rad + piece * way_rad, leg_speed, rest_s)
            at_rad = goal_rad


def _wander(rng: np.random.Generator, size_rad: float) -> list[tuple[float, float, float]]:
    """Amplitude, rad, angular frequency, rad/s, and phase of slow waves whose sum has this standard deviation."""
    count = 4
    amplitude = size_rad * math.sqrt(2.0 / count)
    return [
        (amplitude, 2.0 * math.pi * float(rng.uniform(0.1, 0.6)), float(rng.uniform(0.0, 2.0 * math.pi)))
        for _ in range(count)
    ]


def _tremor(rng: np.random.Generator, size_rad: float) -> list[tuple[float, float, float]]:
    """Two close lines that beat; larger than asked by what the arm's own inertia takes off them."""
    waves = []
    for _ in range(2):
        hz = float(rng.uniform(8.0, 12.0))
        waves.append((size_rad * (hz / HAND_HZ) ** 2, 2.0 * math.pi * hz, float(rng.uniform(0.0, 2.0 * math.pi))))
    return waves


class Script(Mover):
    """Through `points`, [[t_s, deg], …]; t counts from when the first is reached, at a peak speed of `deg_s`.

    Between the points a monotone cubic (PCHIP, Fritsch and Carlson 1980), which never overshoots them. It comes to rest
    after the last.
    """

    def __init__(self, begin: Begin, points: Any = None, deg_s: float = 60.0) -> None:
        times_s, angles_rad = _read_points(points)
        peak_rad_s = radians_per_s("deg_s", deg_s)
        curve = PchipInterpolator(times_s, angles_rad)
        self._times_s = times_s.tolist()
        self._pieces = curve.c.T.tolist()
        self._origin_s = 0.0
        first = self._on_curve(self._times_s[0])
        there = begin.motion[:2] == first[:2]
        lasts_s = 0.0 if there else lasting_s(begin.motion.angle_rad, first.angle_rad, peak_rad_s)
        self._lead = None if there else Quintic(begin.time_s, lasts_s, begin.motion, first)
        self._origin_s = begin.time_s + lasts_s - self._times_s[0]
        self._last_s = self._origin_s + self._times_s[-1]
        end = self._on_curve(self._last_s)
        rest = Motion(end.angle_rad + 0.5 * STOPS_WITHIN_S * end.velocity_rad_s)
        self._stop = Quintic(self._last_s, STOPS_WITHIN_S, end, rest)

    def at(self, time_s: float) -> Motion:
        """The motion at a time."""
        if self._lead is not None and time_s < self._lead.end_s:
            return self._lead.at(time_s)
        if time_s >= self._last_s:
            return self._stop.at(time_s)
        return self._on_curve(time_s)

    def _on_curve(self, time_s: float) -> Motion:
        at_s = time_s - self._origin_s
        piece = min(max(bisect.bisect_right(self._times_s, at_s) - 1, 0), len(self._pieces) - 1)
        t = at_s - self._times_s[piece]
        c3, c2, c1, c0 = self._pieces[piece]
        return Motion(c0 + t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + t * 3.0 * c3), 2.0 * c2 + 6.0 * t * c3)


def _read_points(points: Any) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, rising from 0 or later, and angles, rad."""
    if not (isinstance(points, Sequence) and len(points) >= 2 and all(_is_point(point) for point in points)):
        raise ArmError("an arm's script needs 'points': two or more [time in s, angle in degrees]")
    times_s = np.array([float(point[0]) for point in points])
    if not (np.all(np.isfinite(times_s)) and times_s[0] >= 0.0 and np.all(np.diff(times_s) > 0.0)):
        raise ArmError("the times of an arm's script must rise from each point to the next, from 0 s or later")
    return times_s, np.array([radians("points", point[1]) for point in points])


def _is_point(point: Any) -> bool:
    pair = isinstance(point, Sequence) and not isinstance(point, str) and len(point) == 2
    return pair and all(isinstance(value, int | float) and not isinstance(value, bool) for value in point)


class Waves(Mover):
    """Slow waves added up, as offline records of hidden patients move: middle + Σ deg_i sin(2π hz_i t + phase_i).

    Lists of equal length: frequencies, amplitudes, and phases in rad at the time when it takes over. It is first
    brought into the movement with a peak speed of about `deg_s`.
    """

    def __init__(
        self,
        begin: Begin,
        hz: Any = (0.1,),
        deg: Any = (20.0,),
        phase_rad: Any = (0.0,),
        middle_deg: float = 90.0,
        deg_s: float = 60.0,
    ) -> None:
        lists = (hz, deg, phase_rad)
        if not all(isinstance(each, Sequence) and not isinstance(each, str) for each in lists):
            raise ArmError("the arm's waves need 'hz', 'deg' and 'phase_rad': lists of numbers")
        if len({len(each) for each in lists}) != 1:
            raise ArmError("the arm's 'hz', 'deg' and 'phase_rad' must be equally long")
        self._waves = [
            (
                radians("deg", size, 0.0, 90.0),
                2.0 * math.pi * within("hz", each, 0.0, 5.0),
                within("phase_rad", phase, -1e6, 1e6),
            )
            for each, size, phase in zip(hz, deg, phase_rad, strict=True)
        ]
        self._middle_rad, self._begin_s = radians("middle_deg", middle_deg), begin.time_s
        peak_rad_s = radians_per_s("deg_s", deg_s)
        lasts_s = lasting_s(begin.motion.angle_rad, self._wave(begin.time_s).angle_rad, peak_rad_s)
        self._lead = Quintic(begin.time_s, lasts_s, begin.motion, self._wave(begin.time_s + lasts_s))

    def at(self, time_s: float) -> Motion:
        """The motion at a time."""
        return self._lead.at(time_s) if time_s < self._lead.end_s else self._wave(time_s)

    def _wave(self, time_s: float) -> Motion:
        since_s = time_s - self._begin_s
        angle_rad, velocity_rad_s, acceleration_rad_s2 = self._middle_rad, 0.0, 0.0
        for size_rad, omega, phase in self._waves:
            turn = omega * since_s + phase
            angle_rad += size_rad * math.sin(turn)
            velocity_rad_s += size_rad * omega * math.cos(turn)
            acceleration_rad_s2 -= size_rad * omega * omega * math.sin(turn)
        return Motion(angle_rad, velocity_rad_s, acceleration_rad_s2)


MOVERS: dict[str, Callable[..., Mover]] = {
    "free": Free,
    "hand": Hand,
    "held": Fixture,
    "robot": Robot,
    "script": Script,
    "waves": Waves,
}
"""By name, in alphabetical order."""


def make_mover(mode: str, begin: Begin, settings: Mapping[str, Any]) -> Mover:
    """The named mover.

    Raises ArmError: there is no such mover, or it has no such setting, or a value makes no sense.
    """
    if mode not in MOVERS:
        raise ArmError(f"unknown mode of the arm {mode!r}; there are {', '.join(MOVERS)}")
    known = list(inspect.signature(MOVERS[mode]).parameters)[1:]
    for key, value in settings.items():
        if key not in known:
            raise ArmError(f"mode '{mode}' of the arm has no setting '{key}'; it has {', '.join(known) or 'none'}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ArmError(f"the arm's '{key}' must be a finite number, not {value!r}")
    return MOVERS[mode](begin, **settings)

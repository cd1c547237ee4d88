"""Nobody holds the forearm: it moves by its muscle, its tissue and gravity. Fourth-order Runge-Kutta."""

from __future__ import annotations

from stimrig.hardware_sim.arm.motion import Begin, Drive, Motion


class Mover:
    """From where it is let go."""

    holds = False

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

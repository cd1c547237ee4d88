"""A robot sweeps the forearm to and fro: its own second-order dynamics behind a reference, and a velocity limit."""

from __future__ import annotations

import math
from collections.abc import Iterator

from stimrig.hardware_sim.arm.motion import FASTEST_DEG_S, SLOWEST_DEG_S, Begin, Drive, Motion, radians, within
from stimrig.hardware_sim.arm.servo import Leg, Path, Servo


class Mover:
    """Between `from_deg` and `to_deg` at `deg_s`, with a rest of `pause_s` at both; first to `from_deg`."""

    holds = True

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
        rad_s = radians("deg_s", deg_s, SLOWEST_DEG_S, FASTEST_DEG_S)
        rest_s = within("pause_s", pause_s, 0.0, 3600.0)

        def legs() -> Iterator[Leg]:
            while True:
                for end_rad in ends_rad:
                    yield Leg(end_rad, rad_s, rest_s)

        self._servo = Servo(
            begin,
            Path(begin.time_s, begin.motion.angle_rad, legs()).at,
            within("bandwidth_hz", bandwidth_hz, 0.2, 30.0),
            within("damping", damping, 0.3, 3.0),
            math.radians(within("limit_deg_s", limit_deg_s, SLOWEST_DEG_S, FASTEST_DEG_S)),
        )

    def advance(self, time_s: float, drive: Drive) -> Motion:  # noqa: ARG002
        """The motion at `time_s`."""
        return self._servo.at(time_s)

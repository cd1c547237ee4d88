"""What low and mid level of the P24 share: results, and the points that a pulse's shape is made of."""

from __future__ import annotations

from collections.abc import Sequence

from hardware_sim.electrodes import Point

OK, TRANSFER, PARAMETER, NOT_INITIALISED, HIGH_VOLTAGE = 0, 1, 2, 7, 8
ELECTRODE, INVALID_COMMAND, PULSE_TIMEOUT, LOW_CURRENT = 10, 11, 16, 28
ELECTRODE_DETECTION_MA = 15.0
LARGEST_CURRENT_MA = 130.0
POINT_BYTES = 4


def parse_points(data: bytes, count: int) -> list[Point] | None:
    """`count` points of u32 big endian, µs << 20 | (2·mA + 300) << 10; None where the length differs."""
    if len(data) != count * POINT_BYTES:
        return None
    words = (int.from_bytes(data[i : i + POINT_BYTES], "big") for i in range(0, len(data), POINT_BYTES))
    return [(word >> 20, ((word >> 10 & 0x3FF) - 300) / 2) for word in words]


def within_limits(points: Sequence[Point]) -> bool:
    """Whether the device would drive this shape: currents up to 130 mA either way, and some duration."""
    currents_fit = all(-LARGEST_CURRENT_MA <= current <= LARGEST_CURRENT_MA for _, current in points)
    return currents_fit and sum(width for width, _ in points) > 0

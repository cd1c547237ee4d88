"""What the P24's low and mid level share: result codes, and the points that a pulse's shape is made of."""

from __future__ import annotations

from collections.abc import Sequence

from stimrig.hardware_sim.electrodes import Point

OK, TRANSFER, PARAMETER, NOT_INITIALISED, HIGH_VOLTAGE = 0, 1, 2, 7, 8
ELECTRODE, INVALID_COMMAND = 10, 11
ELECTRODE_DETECTION_MA = 15.0
LARGEST_CURRENT_MA = 130.0
POINT_BYTES = 4


def parse_points(data: bytes, count: int) -> list[Point] | None:
    """`count` points of u32 big endian, µs << 20 | (2·mA + 300) << 10; None if the length differs."""
    if len(data) != count * POINT_BYTES:
        return None
    words = (int.from_bytes(data[i : i + POINT_BYTES], "big") for i in range(0, len(data), POINT_BYTES))
    return [(word >> 20, ((word >> 10 & 0x3FF) - 300) / 2) for word in words]


def within_limits(points: Sequence[Point]) -> bool:
    """Whether the device accepts this shape: currents within ±130 mA and some duration."""
    currents_fit = all(-LARGEST_CURRENT_MA <= current <= LARGEST_CURRENT_MA for _, current in points)
    return currents_fit and sum(width for width, _ in points) > 0

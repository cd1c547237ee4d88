"""Values that pass through the rig: pulses to the stimulator; acks and blocks of torque from the devices."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray


class PulseStatus(IntEnum):
    """Outcome of a planned pulse; the values of `/pulses/status` in a recording."""

    ACKNOWLEDGED = 0
    REST = 1
    DROPPED = 2
    REFUSED = 3
    UNACKNOWLEDGED = 4
    DEVICE_ERROR = 5


MAY_BE_FELT = PulseStatus.ACKNOWLEDGED, PulseStatus.UNACKNOWLEDGED, PulseStatus.DEVICE_ERROR


@dataclass(frozen=True, slots=True)
class Pulse:
    """One stimulation pulse as asked for: width of a phase in µs, current in mA. Width 0 is no pulse."""

    pulse_width_us: float
    current_ma: float

    @property
    def charge_uc(self) -> float:
        """Charge of one phase, µC."""
        return self.pulse_width_us * self.current_ma * 1e-3


LaidBy = Literal["plan", "extension", "wait", "end"]


class Segment(NamedTuple):
    """A segment as indices of its pulses, end exclusive, and who laid it."""

    name: str
    start: int
    end: int
    by: LaidBy


class LateError(Exception):
    """A pulse's latest time had passed right before the write, so nothing was written."""


@dataclass(frozen=True, slots=True)
class Ack:
    """A stimulator's answer to one pulse: `error` is None when it was delivered, `number` -1 if it names no pulse."""

    number: int
    time_s: float
    error: str | None = None


SAMPLE = np.dtype(
    [("host_time_s", "<f8"), ("stamp_s", "<f8"), ("torque_nm", "<f8"), ("counter", "<i8"), ("sync", "u1")]
)
"""One torque sample: host receive time (rig clock), the transport's own stamp (NaN: none), torque in N·m, the
cell's counter (raw from a device, unwrapped after the receiver; −1: none), sync line (255: none)."""


ANGLE_SAMPLE = np.dtype(
    [
        ("host_time_s", "<f8"),
        ("stamp_s", "<f8"),
        ("raw", "<f8"),
        ("angle_rad", "<f8"),
        ("counter", "<i8"),
        ("fault", "u1"),
    ]
)
"""One angle sample: as `SAMPLE`, with the sensor's own value, the joint's angle in rad (from a device by the rig file,
after the receiver by the calibration), and whether it reports a fault (0: no; 255: it has no such word;
everything else: it does)."""
TRUSTED = 0, 255


@dataclass(frozen=True, slots=True)
class Block:
    """Samples in the order of arrival, dtype `SAMPLE` or `ANGLE_SAMPLE`, shape (n,); n may be 0."""

    samples: NDArray[np.void]
    malformed: int = 0
    error_frames: int = 0

    def __len__(self) -> int:
        return len(self.samples)


Values = TypeVar("Values", float, NDArray[np.float64])


@dataclass(frozen=True, slots=True)
class AngleScale:
    """From a sensor's value to the joint's angle: `direction` × `radians_per_unit` × (raw − `offset`)."""

    offset: float = 0.0
    direction: int = 1
    radians_per_unit: float = 1.0

    def angle_rad(self, raw: Values) -> Values:
        """The joint's angle, or angles of the shape of `raw`, rad."""
        return self.direction * self.radians_per_unit * (raw - self.offset)


@dataclass(slots=True)
class Recorded:
    """Counts that the run keeps while it records."""

    samples: int = 0
    lost_samples: int = 0
    duplicate_samples: int = 0
    disordered_samples: int = 0
    malformed_frames: int = 0
    error_frames: int = 0

"""From samples to pulse intervals: one row per pulse, whatever the sampling rate.

All estimates use the grid of pulses: 40 rows per second show all that a muscle with a time constant of 0.1 s or more
does, and the mean over an interval keeps the information of its samples. The exact times matter: an error of 1.25 ms
(half a sample) cost 36 units of log-likelihood in a trial. Therefore the model of a mean is the mean of the model's
curve at the times of that interval's samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.repeats import find_repeats
from stimrig.identify.dynamics.second_order import CUBIC, Core, curve_weights, mean_weights, read_at
from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.clock import pulse_phase_s
from stimrig.identify.records.readings import Readings
from stimrig.identify.records.record import FORGOTTEN_S, Record

FUSED = 0.2
"""Share of an interval. A pulse that is late by less prolongs the drive before it (an early one shortens it). The
drive of a pulse that is late by more is moved as a whole to the interval in which it came.

Twitches fuse over a short pause, but not over a long one. With 0, twitches would always add up; with 1, a drive would
always last until it changes. For a fast muscle with 5 % of the pulses up to 60 ms late, the error was 1.0 times the
noise with this value, 2.7 times with 1, and 1.8 times if all pulses were taken as on time.
"""
PLACES = 1024
"""Largest number of different sample places within an interval. More are rounded: 24 µs at 40 pulses/s does not
matter."""
LONG = 8.0
"""If the quicker lag is longer than this many intervals, the error of a cubic is less than 2e-6 of the torque."""


@dataclass(frozen=True)
class Grid:
    """A record on the grid of its pulses."""

    record: Record  # that was put on the grid
    start_s: float  # time of the first pulse slot, s
    step_s: float  # pulse interval, s
    pulse_width_us: np.ndarray  # width held in each interval, µs, shape (K,)
    torque_nm: np.ndarray  # mean of the samples in each interval, N·m, shape (K,)
    count: np.ndarray  # samples in each interval, int, shape (K,); at 0 the torque is NaN, and it is never fitted
    interval: np.ndarray  # of each sample, shape (N,)
    fraction: np.ndarray  # place of each sample within its interval, 0 to 1, shape (N,)
    held_out: np.ndarray  # intervals with any held-out sample, bool, shape (K,)
    segment: np.ndarray  # index into the record's `segment_names`, int, shape (K,)
    angle_rad: np.ndarray | None  # of the joint, smoothed, mean over each interval, shape (K,)
    velocity_rad_s: np.ndarray | None  # the same; of a record without an angle as recorded, shape (K,)
    late_s: np.ndarray | None  # delay of each interval's pulse after its slot, s, shape (K,); None if none was late
    doubted: np.ndarray  # intervals in which the stimulation is not known, bool, shape (K,)
    part: np.ndarray  # index into the record's `parts`; a pause belongs to the part before it, int, shape (K,)
    resumed: np.ndarray
    """Intervals at whose start the muscle's state is not known, since the stimulation before is not known; int."""
    noise_sd_nm: float = 0.0  # white noise of a sample, estimated from the samples, N·m; 0 if it was not estimated
    readings: Readings | None = None  # the readings behind the samples, if they are fewer or coarse

    def readings_in(self, rows: np.ndarray) -> float:
        """Readings in one of these intervals, at least 1: held samples are not averaged."""
        each = 1.0 if self.readings is None else self.readings.samples_each
        return max(float(np.median(self.count[rows])) / each, 1.0)

    def mean_noise_nm(self, rows: np.ndarray) -> float:
        """White noise of the mean over one of these intervals, N·m."""
        return self.noise_sd_nm / float(np.sqrt(self.readings_in(rows)))

    @property
    def size(self) -> int:
        """Number of intervals, K."""
        return self.pulse_width_us.size

    @cached_property
    def time_s(self) -> np.ndarray:
        """Start of each interval, s, shape (K,)."""
        return self.start_s + self.step_s * np.arange(self.size)

    @cached_property
    def fitted(self) -> np.ndarray:
        """bool, shape (K,): intervals that may be used to fit and to choose.

        An interval with fewer than half of its samples (at an edge or a gap) is left out, since its mean is noisier. So
        is an interval in which the stimulation is not known.
        """
        return self.comparable & ~self.held_out

    @cached_property
    def comparable(self) -> np.ndarray:
        """bool, shape (K,): intervals whose stimulation and mean torque are known; of `validate`, too."""
        usual = float(np.median(self.count[self.count > 0])) if np.any(self.count) else 1.0
        return ~self.doubted & (self.count > 0) & (2 * self.count >= usual)

    @cached_property
    def repeats(self) -> np.ndarray:
        """int, shape (K,): the same number for intervals with the same input; -1 where it did not repeat."""
        known = self.comparable.copy()
        known[self.starts] = False
        return find_repeats(self.pulse_width_us, known, round(FORGOTTEN_S / self.step_s))

    @cached_property
    def counted(self) -> np.ndarray:
        """bool, shape (N,): samples whose error counts; samples of `validate` are among them."""
        return ~self.doubted[self.interval]

    @cached_property
    def begins(self) -> np.ndarray:
        """Intervals at which the parts of the record begin, shape (B,), the first 0."""
        return np.searchsorted(self.part, np.arange(len(self.record.parts))).astype(np.int64)

    @cached_property
    def starts(self) -> np.ndarray:
        """Intervals at whose start the state is unknown, shape (S,): the starts of parts, and `resumed`."""
        return np.union1d(self.begins, self.resumed)

    @cached_property
    def widths_us(self) -> tuple[np.ndarray, np.ndarray]:
        """The different widths, rising, µs, and the index of each interval's."""
        return np.unique(self.pulse_width_us, return_inverse=True)

    @property
    def delay_bounds_s(self) -> tuple[float, float]:
        """Bounds of the delay in every model, s: one sample in both directions. A longer delay is an effect."""
        sample_s = min(1.02 / self.record.sample_rate_hz, 1.02 * self.step_s)
        return -sample_s, sample_s

    def stretches(self, rows: np.ndarray) -> list[slice]:
        """Contiguous runs of some intervals, each within one part. Noise is correlated only within a run."""
        return [run for index in range(len(self.record.parts)) for run in runs(rows & (self.part == index))]

    def interval_means(self, drive_nm: np.ndarray, axis: int = 0) -> np.ndarray:
        """The mean drive of each interval, with late pulses at their true time; `axis` is that of the intervals.

        If a pulse is late by less than `FUSED` of an interval, the drive before it lasts that much longer; if it is
        early, that much shorter. The silence after the last pulse of a train begins as late as that pulse. The drive of
        a pulse that is later is added to the intervals in which it came.
        """
        if self._shifts is None:
            return drive_nm
        rows, late, early, moved, at, share = self._shifts
        drive = np.moveaxis(drive_nm, axis, 0)
        lift = (slice(None),) + (None,) * (drive.ndim - 1)
        result = np.copy(drive, order="K")
        if moved.size:
            result[moved] = 0.0
        base = result[np.r_[rows, np.maximum(rows - 1, 0), np.minimum(rows + 1, self.size - 1)]]
        current, before, after = np.split(base, 3)
        result[rows] = current + late[lift] * (before - current) + early[lift] * (after - current)
        for target, part in zip(at, share, strict=True):
            inside = (target >= 0) & (target < self.size)
            np.add.at(result, target[inside], part[inside][lift] * drive[moved[inside]])
        return np.moveaxis(result, 0, axis)

    @cached_property
    def _shifts(self) -> tuple[np.ndarray, ...] | None:
        """Shifts of the drive by late pulses: rows, their shares of the intervals before and after, moved pulses."""
        if self.late_s is None or not np.any(self.late_s):
            return None
        part = self.late_s / self.step_s
        moved = np.flatnonzero((np.abs(part) >= FUSED) & (part != 0) & (self.pulse_width_us > 0))
        whole = np.floor(part[moved]).astype(np.int64)
        rest = part[moved] - whole
        part[moved] = 0.0
        empty = self.pulse_width_us == 0
        empty[moved] = True
        ends = np.flatnonzero(empty[1:] & ~empty[:-1]) + 1
        part[ends] = part[ends - 1]
        late = np.clip(part, 0.0, 1.0)
        late[0] = 0.0
        early = np.r_[np.clip(-part[1:], 0.0, 1.0), 0.0]
        early = np.minimum(early, 1.0 - late)
        rows = np.flatnonzero(late + early)
        at = np.stack([moved + whole, moved + whole + 1])
        return rows, late[rows], early[rows], moved, at, np.stack([1.0 - rest, rest])

    def at_samples(
        self, torque_nm: np.ndarray, rate_nm_s: np.ndarray, lag: float, core: Core | None = None
    ) -> np.ndarray:
        """The curve through boundary states at the samples, delayed by `lag` intervals, shape (N,)."""
        places, place = self._places
        offset = np.floor(places - lag)
        four = curve_weights(places - lag - offset, self.step_s, *(core or CUBIC))
        return read_at(torque_nm, rate_nm_s, self.interval, place, offset.astype(np.int64), four)

    def mean_weights(self, delay_s: float = 0.0, core: Core | None = None) -> tuple[int, np.ndarray]:
        """Weights that give each interval's mean from the boundary states, for a model with a delay, s.

        `core` says that the curve between two states is exact, None that it is a cubic. Returns the offset of the
        earliest boundary used, relative to the interval (0 or negative), and the weights of (y, y') at the boundaries
        from there on, shape (K, B, 2), or (1, B, 2) if all intervals have the same.
        """
        if (delay_s, core) not in self._weights:
            if len(self._weights) >= 8:  # a fit needs the same weights several times, then never again
                self._weights.clear()
            places, place = self._places
            shifted = places - delay_s / self.step_s
            offset = np.floor(shifted).astype(np.int64)
            four = curve_weights(shifted - offset, self.step_s, *(core or CUBIC))
            interval, count = self.interval, self.count
            if self._evenly_sampled:  # one row holds for all intervals
                place, interval, count = np.arange(places.size), np.zeros(places.size, np.int64), count[:1]
            self._weights[delay_s, core] = mean_weights(four, offset, place, interval, count)
        return self._weights[delay_s, core]

    @cached_property
    def _weights(self) -> dict[tuple[float, Core | None], tuple[int, np.ndarray]]:
        return {}

    @cached_property
    def _evenly_sampled(self) -> bool:
        each = int(self.count[0])
        if not each or np.any(self.count != each):
            return False
        return bool(np.max(np.ptp(self.fraction.reshape(-1, each), axis=0)) < 1e-9)

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Places of samples within an interval, shape (U,), and the index of each sample's place, shape (N,)."""
        if self._evenly_sampled:
            each = int(self.count[0])
            return self.fraction[:each], np.tile(np.arange(each), self.size)
        places, place = np.unique(np.round(self.fraction, 8), return_inverse=True)
        if places.size > PLACES:  # the clocks of samples and pulses drift apart
            places, place = np.unique(np.round(self.fraction * PLACES), return_inverse=True)
            places = places / PLACES
        return places, place

    def curve(self, core: Core) -> Core | None:
        """Choose how the curve between states is read: exactly (`core`), or as a cubic (None) if both lags are long.

        For a numerical derivative use the same choice for all points; otherwise the result has a jump.
        """
        time_constant_s, damping = core
        quick_s = time_constant_s / (max(damping, 1.0) + np.sqrt(max(damping * damping - 1.0, 0.0)))
        return None if quick_s > LONG * self.step_s else core


def ends_of(parts: list[slice]) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends of some runs, as compiled functions take them."""
    return np.array([part.start for part in parts], np.int64), np.array([part.stop for part in parts], np.int64)


def runs(flags: np.ndarray) -> list[slice]:
    """Contiguous runs of true values, as slices."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(np.int8), 0]))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def make_grid(record: Record) -> Grid:
    """Put a record on the grid of its pulses.

    Raises BadRecord: fewer than eight pulse intervals, sampled more slowly than the pulses, not finite, negative
    widths, time that does not rise, an impossible pulse rate, or longer than a day.
    """
    _check(record)
    step_s, rate_hz = 1.0 / record.pulse_rate_hz, record.sample_rate_hz
    start_s = record.time_s[0] + pulse_phase_s(record)
    # A small shift, so that a sample taken at the pulse itself falls into the interval that starts with the pulse.
    position = (record.time_s - start_s) / step_s + 1e-6 + 1e-3 * min(1.0, record.pulse_rate_hz / rate_hz)
    interval = np.floor(position).astype(np.int64)
    lowest = int(interval[0])
    start_s, position, interval = start_s + lowest * step_s, position - lowest, interval - lowest
    size = int(interval[-1]) + 1
    if size < 8:
        raise BadRecord(f"only {size} pulse intervals long", fix="Give at least a few seconds of data.")
    count = np.bincount(interval, minlength=size)
    filled = np.maximum(count, 1)

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.bincount(interval, values, minlength=size) / filled
        return np.where(count > 0, total, np.nan)

    first_of = np.searchsorted(interval, np.arange(size))
    # The middle sample of an interval: a pulse one sample early or late does not change it. Where samples are missing,
    # the last known width is assumed.
    middle = np.where(count > 0, first_of + count // 2, np.maximum(first_of - 1, 0))
    following = record.part[np.minimum(first_of, record.time_s.size - 1)]
    part = record.part[middle]
    pause = (count == 0) & (following != part)
    width, late_s, doubted, resumed = _applied(record, middle, start_s, step_s, (count == 0) & ~pause, part)
    # There is no stimulation between two parts, whatever the width at the end of the first.
    width[pause] = 0.0
    if late_s is not None:
        late_s[pause] = 0.0
    if record.doubted is not None:
        doubted |= np.bincount(interval, record.doubted, minlength=size) > 0
    motion = record.motion
    velocity = record.velocity_rad_s if motion is None else motion.velocity_rad_s
    return Grid(
        record=record,
        start_s=start_s,
        step_s=step_s,
        pulse_width_us=width,
        torque_nm=mean(record.torque_nm),
        count=count,
        interval=interval,
        fraction=np.clip((record.time_s - start_s) / step_s - interval, 0.0, 1.0),
        held_out=np.bincount(interval, record.held_out, minlength=size) > 0,
        segment=record.segment[middle],
        angle_rad=None if motion is None else mean(motion.angle_rad),
        velocity_rad_s=None if velocity is None else mean(velocity),
        late_s=late_s,
        doubted=doubted,
        part=part,
        resumed=resumed,
    )


def _applied(
    record: Record, middle: np.ndarray, start_s: float, step_s: float, gaps: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]:
    """Width and lateness of each interval, whether its stimulation is unknown, and where the state is then unknown.

    Where samples are missing, the record's list of pulses is used, if it has one. Otherwise the stimulation in the gap
    is unknown, except between two rests with the same torque. After such a gap the state is unknown, and the intervals
    are doubted as long as a delayed response to the gap may last; held-out pulses until the muscle has forgotten it.
    """
    width = record.pulse_width_us[middle]
    late = np.zeros(width.size) if record.late_s is None else record.late_s[middle]
    doubted, resumed = np.zeros(width.size, bool), []
    if gaps.any() and record.pulses is not None:
        known = record.pulses
        place = np.round((known.time_s - start_s) / step_s).astype(np.int64)
        inside = (place >= 0) & (place < width.size)
        for target, values in ((width, known.width_us), (late, known.late_s)):
            pulse_values = np.zeros(width.size)
            pulse_values[place[inside]] = values[inside]
            target[gaps] = pulse_values[gaps]
    elif gaps.any():
        for gap in runs(gaps):
            if not (width[gap.start - 1] or _moved(record, middle, gap)):
                continue
            # The initial state of held-out pulses cannot be fitted: the muscle must have forgotten the gap.
            unseen = record.held_out[middle[gap.stop]]
            reach_s = FORGOTTEN_S if unseen else LONGEST_DELAY_S
            after = slice(gap.start, gap.stop + round(reach_s / step_s))
            doubted[after] |= part[after] == part[gap.start]
            if not unseen:
                resumed.append(gap.stop)
    return width, late if late.any() else None, doubted, np.array(resumed, np.int64)


def _moved(record: Record, middle: np.ndarray, gap: slice) -> bool:
    """Return True if the torque differs before and after a gap: then stimulation was cut out between two rests."""
    before, after = middle[max(gap.start - 2, 0)], middle[min(gap.stop, middle.size - 1)]
    near = max(round(record.sample_rate_hz / record.pulse_rate_hz), 1)
    levels = [float(np.mean(record.torque_nm[at : at + near])) for at in (before, after)]
    return abs(levels[1] - levels[0]) > MOVED * float(np.ptp(record.torque_nm))


MOVED = 0.04
"""Share of the torque's range by which the rests before and after a gap differ if stimulation was cut out."""
LONGEST_DELAY_S = 0.25
"""Longest time from a pulse to the first response; a longer memory is part of the state."""


def _check(record: Record) -> None:
    """Refuse arrays that no measurement gives, wherever they come from."""
    bounds.check_rate(record.pulse_rate_hz, "pulse_rate_hz")
    for name in ("time_s", "pulse_width_us", "torque_nm"):
        _refuse(name, ~np.isfinite(getattr(record, name)), "not finite", "Cut the record before this sample.")
    if record.late_s is not None:
        wrong = ~(np.abs(record.late_s) <= bounds.LARGEST["late_s"])
        _refuse("late_s", wrong, f"{record.late_s[np.argmax(wrong)]:g} s late", "Give `late_s` in seconds.")
    _refuse("pulse_width_us", record.pulse_width_us < 0, "negative", "A pulse width is 0 (no pulse) or positive.")
    falling = np.r_[False, np.diff(record.time_s) <= 0]
    _refuse("time_s", falling, "time does not rise", "Sort the samples by time; each time once.")
    if record.time_s[-1] - record.time_s[0] > bounds.LONGEST_S:
        raise BadRecord("longer than a day", place="time_s", fix="Give the time in seconds.")
    if not record.sample_rate_hz >= 0.999 * record.pulse_rate_hz:
        rates = f"{record.sample_rate_hz:.4g} Hz, below the {record.pulse_rate_hz:g} pulses a second"
        raise BadRecord(f"sampled at {rates}", fix="Record at 40 Hz or faster.")


def _refuse(name: str, wrong: np.ndarray, message: str, fix: str) -> None:
    if wrong.any():
        raise BadRecord(message, place=f"{name}, sample {int(np.argmax(wrong))}", fix=fix)

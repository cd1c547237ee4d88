"""The torque receiver: one thread from connect to disconnect, which records while a test runs.

It unwraps the cell's counter, finds lost, repeated and disordered samples, and reports at once a torque outside its
limit or one that is not a number.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.acquire.plausibility import RATE_TOLERANCE, PlausibilityCheck
from rig.acquire.torque_time import TorqueTime
from rig.clock import Clock
from rig.devices import LoadCell
from rig.errors import DeviceError, JournalError
from rig.journal import Journal, Kind
from rig.signals import Recorded, TorqueBlock

log = logging.getLogger("rig.receiver")

READ_TIMEOUT_S = 0.02
SILENCE_S = 1.0
"""Real seconds of reading without a sample after which the cell counts as gone. Its bus is closed, since some drivers
then use a whole processor."""
LONGEST_READ_S = 0.25
"""Real seconds for which one reading counts at most: a machine that stood still did not read."""
LIVE_BLOCKS = 4000
RANGE_MEAN_S = 0.01
"""Seconds of torque of which one mean counts for the range: less noise than in single samples."""
SETTLING_S = 0.1
BACKLOG_RATE = 1.6
BEHIND_S = 0.1
"""Real seconds by which the newest sample may be later than the promptest one of the last `PROMPT_S` real seconds. A
reader that was kept from reading, or that is too slow, is behind: what it reads now was torque long ago."""
PROMPT_S = 5.0
JUMP_ALLOWANCE_S = 0.5
"""A counter that is further ahead of the host's clock than this has jumped, so its samples have no reliable time."""


class CounterUnwrapper:
    """Turns the device's wrapping counter into one that never wraps, across blocks.

    A step of zero is a repeated frame, a step backwards is a late frame: both are left out of the recording.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None

    def unwrap(self, raw: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_], int, int]:
        """Unwrapped counters, which samples to keep, number of repeats, number of late samples."""
        if self._last is None:
            self._last = int(raw[0]) - 1
        ahead = (raw - self._last + self._modulus // 2) % self._modulus - self._modulus // 2
        counter = self._last + ahead
        newest = np.maximum.accumulate(np.concatenate([[self._last], counter]))
        keep = counter > newest[:-1]
        repeats = int(np.sum(counter == newest[:-1]))
        self._last = int(newest[-1])
        return counter, keep, repeats, int(len(raw) - np.sum(keep)) - repeats


class Receiver:
    """Owns the load cell's reading thread.

    Parameters
    ----------
    cell
        An opened load cell.
    on_lost
        Called once, with the reason, when the cell is gone; the thread then ends.
    """

    def __init__(self, cell: LoadCell, clock: Clock, on_lost: Callable[[str], None]) -> None:
        self._cell = cell
        self._clock = clock
        self._on_lost = on_lost
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._unwrapper = CounterUnwrapper(cell.counter_modulus) if cell.counter_modulus else None
        self._journal: Journal | None = None
        self._limits_nm = (-np.inf, np.inf)
        self._plausibility: PlausibilityCheck | None = None
        self._on_fault: Callable[[str], None] = lambda _: None
        self._previous: tuple[int, float] | None = None
        self._rate: deque[tuple[float, int, float]] = deque(maxlen=2000)
        self._total = 0
        self.counts = Recorded()
        self.last_s: float | None = None
        self.last_unix_s: float | None = None
        self.last_torque_nm: float | None = None
        self.peak_nm = 0.0
        self.range_nm = (np.inf, -np.inf)
        self.torque_time = TorqueTime()
        self._unaveraged_nm = np.empty(0)
        self.live: deque[NDArray[Any]] = deque(maxlen=LIVE_BLOCKS)
        self.recent: deque[tuple[float, float]] = deque(maxlen=400)

    @property
    def nominal_rate_hz(self) -> float:
        """Samples per second according to the rig file."""
        return self._cell.sample_rate_hz

    def start(self) -> None:
        """Start reading."""
        self._thread = threading.Thread(target=self._run, name="torque-receiver", daemon=True)
        self._thread.start()

    @property
    def living(self) -> bool:
        """Whether its thread still runs."""
        return self._thread is not None and self._thread.is_alive()

    def close(self) -> None:
        """End the thread and close the bus."""
        self._closing.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
        self._cell.close()

    def record(
        self,
        journal: Journal,
        limits_nm: tuple[float, float],
        on_fault: Callable[[str], None],
        plausibility: PlausibilityCheck | None = None,
    ) -> None:
        """From now on write every sample to the journal and check it; faults are reported at once."""
        with self._lock:
            self._plausibility, self.torque_time = plausibility, TorqueTime()
            self._journal, self._limits_nm, self._on_fault = journal, limits_nm, on_fault
            self.counts, self.peak_nm = Recorded(), 0.0
            self._begin_range()

    def begin_range(self) -> None:
        """Forget the range until now: the limb may have moved before the first pulse."""
        with self._lock:
            self._begin_range()

    def _begin_range(self) -> None:
        self.range_nm, self._unaveraged_nm = (np.inf, -np.inf), np.empty(0)

    def release(self) -> Recorded:
        """Stop recording; returns the counts since `record`."""
        with self._lock:
            self._journal = self._plausibility = None
            self._limits_nm, self._on_fault = (-np.inf, np.inf), lambda _: None
            return replace(self.counts)

    def age_s(self, now_s: float) -> float:
        """Age of the newest sample, infinite before the first."""
        last_s = self.last_s
        return np.inf if last_s is None else now_s - last_s

    def settled(self) -> bool:
        """Whether what arrives is of now: at the cell's own rate, not faster, and not behind.

        If samples arrive faster, old ones from a buffer are being read: after a pause of host or adapter.
        """
        since_s = self._clock.now_s() - SETTLING_S * self._clock.speed
        rate = [entry for entry in tuple(self._rate) if entry[0] >= since_s]
        if len(rate) < 2 or rate[-1][0] - rate[0][0] < 0.5 * SETTLING_S * self._clock.speed:
            return False
        rate_hz = (rate[-1][1] - rate[0][1]) / (rate[-1][0] - rate[0][0])
        return rate_hz <= BACKLOG_RATE * self.nominal_rate_hz and self.behind_s() <= BEHIND_S * self._clock.speed

    def behind_s(self) -> float:
        """How much later the newest sample came than the promptest one of the last seconds, rig seconds; at least 0.

        Its number says when it was due. A cell may be slower than its nominal rate by `RATE_TOLERANCE`.
        """
        rate = tuple(self._rate)
        if not rate:
            return 0.0
        now_s, _, delay_s = rate[-1]
        since_s = now_s - PROMPT_S * self._clock.speed
        return max(
            delay_s - then_delay_s - RATE_TOLERANCE * (now_s - then_s)
            for then_s, _, then_delay_s in rate
            if then_s >= since_s
        )

    def torque_around(self, duration_s: float) -> float | None:
        """Median of the torque over the last `duration_s`, N·m; None if there is none."""
        since_s = self._clock.now_s() - duration_s
        values = [torque for time_s, torque in tuple(self.recent) if time_s >= since_s]
        return float(np.median(values)) if values else None

    def changes_lately(self) -> int:
        """How often the torque changed from block to block during the last one or two seconds."""
        means_nm = [torque for _, torque in tuple(self.recent)]
        return int(np.sum(np.abs(np.diff(means_nm)) > 1e-9))  # means of equal samples differ by rounding

    def measured_rate_hz(self) -> float | None:
        """Samples per second over the last seconds, by the host's clock."""
        rate = tuple(self._rate)
        if len(rate) < 2 or rate[-1][0] <= rate[0][0]:
            return None
        return (rate[-1][1] - rate[0][1]) / (rate[-1][0] - rate[0][0])

    def take(self, block: TorqueBlock) -> None:
        """Process one block from the cell: unwrap, record, check."""
        with self._lock:
            self.counts.malformed_frames += block.malformed
            self.counts.error_frames += block.error_frames
            if len(block) == 0:
                return
            samples = self._placed(block.samples)
            if len(samples) == 0:
                return
            self._remember(samples)
            if self._journal is not None:
                self.counts.samples += len(samples)
                try:
                    self._journal.append(Kind.TORQUE, samples.tobytes())
                except JournalError as error:
                    self._on_fault(str(error))
            self._check(samples["torque_nm"])
            if self._plausibility is not None and (fault := self._plausibility.fault(samples)):
                self._on_fault(fault)

    def _placed(self, samples: NDArray[Any]) -> NDArray[Any]:
        """The samples with unwrapped counters, without repeated and late ones; counts the lost ones."""
        if self._unwrapper is None:
            return samples
        counter, keep, repeats, late = self._unwrapper.unwrap(samples["counter"])
        self.counts.duplicate_samples += repeats
        self.counts.disordered_samples += late
        samples = samples[keep].copy()
        samples["counter"] = counter[keep]
        if len(samples) == 0:
            return samples
        before = self._previous or (int(samples["counter"][0]) - 1, float(samples["host_time_s"][0]))
        steps = np.diff(samples["counter"], prepend=before[0])
        missing = int(np.sum(steps - 1))
        if missing:
            self.counts.lost_samples += missing
            self._check_jump(samples, before, missing)
        self._previous = int(samples["counter"][-1]), float(samples["host_time_s"][-1])
        return samples

    def _check_jump(self, samples: NDArray[Any], before: tuple[int, float], missing: int) -> None:
        elapsed_s = float(samples["host_time_s"][-1]) - before[1]
        if missing / self._cell.sample_rate_hz > elapsed_s + JUMP_ALLOWANCE_S:
            self._on_fault(f"load cell: its counter jumped by {missing} samples within {elapsed_s * 1e3:.0f} ms")

    def _remember(self, samples: NDArray[Any]) -> None:
        self.last_s = float(samples["host_time_s"][-1])
        self.last_unix_s = self._clock.unix_s()
        self.last_torque_nm = float(samples["torque_nm"][-1])
        mean_nm = float(np.mean(samples["torque_nm"]))
        self.recent.append((self.last_s, mean_nm))
        self.torque_time.add(self.last_s, mean_nm)
        self._total += len(samples)
        number = self._total if self._unwrapper is None else int(samples["counter"][-1])
        self._rate.append((self.last_s, self._total, self.last_s - number / self.nominal_rate_hz))
        self.live.append(samples)

    def _check(self, torque_nm: NDArray[np.float64]) -> None:
        lo, hi = self._limits_nm
        within = (torque_nm >= lo) & (torque_nm <= hi)
        if not np.all(within):
            worst = float(torque_nm[np.argmin(within)])
            if np.isnan(worst):
                self._on_fault("load cell: sent a torque that is not a number (NaN); check its amplifier")
            else:
                self._on_fault(f"torque {worst:.2f} N·m is outside {lo:g} … {hi:g} N·m")
        elif self._journal is not None:
            self.peak_nm = max(self.peak_nm, float(np.max(np.abs(torque_nm))))
            self._widen(torque_nm)

    def _widen(self, torque_nm: NDArray[np.float64]) -> None:
        """Widen the range by means over `RANGE_MEAN_S`: however the bus cut the samples into blocks."""
        samples = np.concatenate([self._unaveraged_nm, torque_nm])
        each = max(1, round(RANGE_MEAN_S * self.nominal_rate_hz))
        whole = len(samples) // each * each
        self._unaveraged_nm = samples[whole:]
        if whole:
            means_nm = samples[:whole].reshape(-1, each).mean(axis=1)
            lo_nm, hi_nm = self.range_nm
            self.range_nm = min(lo_nm, float(means_nm.min())), max(hi_nm, float(means_nm.max()))

    def _run(self) -> None:
        try:
            self._read_all()
        except Exception as error:  # a bug in a driver or here: report it at once, not after a timeout
            log.exception("the torque receiver failed")
            self._lose(f"load cell: internal: {type(error).__name__}: {error}")

    def _read_all(self) -> None:
        silent_s = 0.0
        while not self._closing.is_set():
            began_s = self._clock.now_s()
            try:
                block = self._cell.read(READ_TIMEOUT_S)
            except DeviceError as error:
                self._lose(str(error))
                return
            read_s = min(self._clock.now_s() - began_s, LONGEST_READ_S * self._clock.speed)
            silent_s = 0.0 if len(block) else silent_s + read_s
            self.take(block)
            if silent_s > SILENCE_S * self._clock.speed:
                self._lose(f"load cell: silent for {SILENCE_S:g} s; check its cable and supply")
                return

    def _lose(self, reason: str) -> None:
        if not self._closing.is_set():
            self._cell.close()
            self._on_lost(reason)

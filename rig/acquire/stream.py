"""Base of the receivers of torque and angle: one each, from connect to disconnect.

A stream unwraps the device's counter, finds lost, repeated and disordered samples, measures the rate, and notices
silence and samples that come late.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.align import RATE_TOLERANCE
from stimrig.rig.devices import Sensor
from stimrig.rig.errors import JournalError
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.signals import Block, Recorded
from stimrig.rig.tasks import Signal, Task, Tasks

log = logging.getLogger("rig.receiver")

LOOK_S = 0.05
"""Real seconds between two looks at whether samples still come."""
SILENCE_S = 1.0
"""Real seconds of reading without a sample after which a device counts as gone. Its bus is closed, since some drivers
then use a whole processor."""
LONGEST_READ_S = 0.25
"""Real seconds for which one reading counts at most: a machine that stood still did not read."""
SETTLING_S = 0.1
SETTLE_S = 3.0
"""Real seconds to wait until a backlog in buffers has been read, and no errors come."""
LOOK_AT = "look at its plug and supply, and at the CAN adapter"
"""Remedy for a sensor from which nothing comes."""
BACKLOG_RATE = 1.6
BEHIND_S = 0.1
"""Real seconds by which the newest sample may be later than the promptest one of the last `PROMPT_S` real seconds. A
reader that was kept from reading, or that is too slow, is behind: what it reads now was measured long ago."""
PROMPT_S = 5.0
JUMP_ALLOWANCE_S = 0.5
"""A counter that is further ahead of the host's clock than this has jumped, so its samples have no reliable time."""

STAMPS_BACK_S = 0.1
"""An adapter's stamp that is further back than this is of a clock that was set, not of a frame that came late."""


class CounterUnwrapper:
    """Turns the device's wrapping counter into one that never wraps, across blocks.

    A step of zero is a repeated frame, a step backwards is a late frame: both are left out of the recording.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None
        self._shift = 0
        self._next: int | None = None

    def resume(self, at: int) -> None:
        """The device may have started again: whatever it counts next is number `at`."""
        self._last, self._next = None, at

    def unwrap(self, raw: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_], int, int]:
        """Unwrapped counters, which samples to keep, number of repeats, number of late samples."""
        if self._next is not None:
            self._shift, self._next = self._next - int(raw[0]), None
        raw = raw + self._shift
        if self._last is None:
            self._last = int(raw[0]) - 1
        # from one to the next: a block that comes after a standstill may be longer than a small counter's half
        half = self._modulus // 2
        counter = self._last + ((steps_from(self._last, raw) + half) % self._modulus - half).cumsum()
        newest = np.maximum.accumulate(np.concatenate(((self._last,), counter)))
        is_new = counter > newest[:-1]
        repeats = int(np.count_nonzero(counter == newest[:-1]))
        self._last = int(newest[-1])
        return counter, is_new, repeats, len(raw) - int(np.count_nonzero(is_new)) - repeats


def steps_from(before: float, values: NDArray[Any]) -> NDArray[Any]:
    """From each value to the next, the first one from `before`: as numpy's `diff`, which is slow for short blocks."""
    steps = np.empty_like(values)
    steps[:1], steps[1:] = values[:1] - before, values[1:] - values[:-1]
    return steps


class Stream:
    """Base of the receivers.

    `source`: a device that is not open yet; `on_lost`: called once, with the reason, when the device is gone.
    """

    def __init__(self, name: str, source: Sensor, tasks: Tasks, on_lost: Callable[[str], None]) -> None:
        self._name, self._source, self._on_lost = name, source, on_lost
        self._tasks, self._clock = tasks, tasks.clock
        self._closing = Signal()
        self._lost = Signal()
        self._watch: Task[None] | None = None
        self._ending: Task[None] | None = None
        """Closes the device after it was lost."""
        self._unwrapper = CounterUnwrapper(source.counter_modulus) if source.counter_modulus else None
        self._journal: Journal | None = None
        self._on_fault: Callable[[str], None] = lambda _: None
        self._on_broken: Callable[[str], None] = lambda _: None
        self._wrong: Callable[[NDArray[Any]], str | None] = lambda _: None
        self._previous: tuple[int, float] | None = None
        self._newest_stamp_s = -np.inf
        self._rate: deque[tuple[float, int, float]] = deque(maxlen=2000)
        self._total = 0
        self.counts = Recorded()
        self.error_s = -math.inf
        """When the adapter last reported an error of the bus, rig time."""
        self._place = "its bus"
        self.last_s: float | None = None
        self.last_unix_s: float | None = None

    @property
    def nominal_rate_hz(self) -> float:
        """Samples per second according to the rig file."""
        return self._source.sample_rate_hz

    async def open(self) -> dict[str, Any]:
        """Open the device and read it from now on; returns its identity. Raises DeviceError."""
        await self._ended()
        self._lost.clear()
        identity = await self._source.open(self._receive, self._lose)
        self._place = identity.get("bus", self._place)
        self._watch = self._tasks.spawn(self._watch_silence(), f"{self._name} receiver")
        return identity

    @property
    def living(self) -> bool:
        """True while it checks that samples come."""
        return self._watch is not None and not self._watch.done.is_set()

    async def close(self) -> None:
        self._closing.set()
        await self._ended()
        await self._source.close()

    def age_s(self, now_s: float) -> float:
        """Age of the newest sample, infinite before the first."""
        last_s = self.last_s
        return np.inf if last_s is None else now_s - last_s

    def settled(self) -> bool:
        """Return whether samples are current: they arrive at the device's own rate, not faster, and not behind.

        If samples arrive faster, old ones from a buffer are being read: after a pause of host or adapter.
        """
        since_s = self._clock.now_s() - SETTLING_S * self._clock.speed
        rate = [entry for entry in tuple(self._rate) if entry[0] >= since_s]
        if len(rate) < 2 or rate[-1][0] - rate[0][0] < 0.5 * SETTLING_S * self._clock.speed:
            return False
        rate_hz = (rate[-1][1] - rate[0][1]) / (rate[-1][0] - rate[0][0])
        return rate_hz <= BACKLOG_RATE * self.nominal_rate_hz and self.behind_s() <= BEHIND_S * self._clock.speed

    def behind_s(self) -> float:
        """Return the newest sample's delay against the promptest one of the last seconds, rig seconds; at least 0.

        Its number says when it was due. A device may be slower than its nominal rate by `RATE_TOLERANCE`.
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

    def measured_rate_hz(self) -> float | None:
        """Samples per second over the last seconds, by the host's clock."""
        rate = tuple(self._rate)
        if len(rate) < 2 or rate[-1][0] <= rate[0][0]:
            return None
        return (rate[-1][1] - rate[0][1]) / (rate[-1][0] - rate[0][0])

    def add(self, block: Block) -> None:
        """Process one block from the device: unwrap, record, check."""
        self.counts.malformed_frames += block.malformed
        self.counts.error_frames += block.error_frames
        if block.error_frames:
            self.error_s = self._clock.now_s()
        if len(block) == 0:
            return
        samples = self._placed(block.samples)
        if len(samples):
            self._time(samples)
            self._store(samples)

    def _store(self, samples: NDArray[Any]) -> None:
        """Record and check samples that have their place."""
        raise NotImplementedError

    def write_to(
        self,
        journal: Journal,
        wrong: Callable[[NDArray[Any]], str | None],
        on_fault: Callable[[str], None],
        on_broken: Callable[[str], None],
    ) -> None:
        """From now on write and check every sample.

        `wrong`: says of a block what is wrong with it, None: nothing; `on_fault`: called with that, at once;
        `on_broken`: called if the journal cannot be written.
        """
        self._journal, self._wrong, self._on_fault, self._on_broken = journal, wrong, on_fault, on_broken
        self.counts = Recorded()

    def release(self) -> Recorded:
        """Stop recording; returns the counts since it began."""
        self._journal, self._wrong = None, lambda _: None
        self._on_fault = self._on_broken = lambda _: None
        return replace(self.counts)

    def _write(self, kind: Kind, samples: NDArray[Any]) -> None:
        if self._journal is not None:
            self.counts.samples += len(samples)
            try:
                self._journal.append(kind, samples.tobytes())
            except JournalError as error:
                self._on_broken(str(error))

    def _check(self, samples: NDArray[Any]) -> None:
        if (fault := self._wrong(samples)) is not None:
            self._on_fault(fault)

    def _placed(self, samples: NDArray[Any]) -> NDArray[Any]:
        """The samples with unwrapped counters, without repeated and late ones; counts the lost ones."""
        if self._unwrapper is None:
            return self._in_order(samples)
        counter, is_new, repeats, late = self._unwrapper.unwrap(samples["counter"])
        self.counts.duplicate_samples += repeats
        self.counts.disordered_samples += late
        samples = samples[is_new].copy()
        samples["counter"] = counter[is_new]
        if len(samples) == 0:
            return samples
        before = self._previous or (int(samples["counter"][0]) - 1, float(samples["host_time_s"][0]))
        missing = int(samples["counter"][-1]) - before[0] - len(samples)
        if missing:
            self.counts.lost_samples += missing
            self._check_jump(samples, before, missing)
        self._previous = int(samples["counter"][-1]), float(samples["host_time_s"][-1])
        return samples

    def _in_order(self, samples: NDArray[Any]) -> NDArray[Any]:
        """Drop repeated and late samples of a device that counts nothing, by its adapter's stamps."""
        stamp_s = samples["stamp_s"]
        if not np.isfinite(stamp_s).all():
            return samples
        newest_s = np.maximum.accumulate(np.concatenate(((self._newest_stamp_s,), stamp_s)))
        behind_s = newest_s[:-1] - stamp_s
        in_order = (behind_s < 0) | (behind_s > STAMPS_BACK_S)  # a clock that was set back begins anew
        repeats = int(np.count_nonzero(behind_s == 0))
        self.counts.duplicate_samples += repeats
        self.counts.disordered_samples += len(samples) - int(np.count_nonzero(in_order)) - repeats
        if in_order.any():
            self._newest_stamp_s = float(stamp_s[in_order][-1])
        return samples[in_order]

    def _check_jump(self, samples: NDArray[Any], before: tuple[int, float], missing: int) -> None:
        elapsed_s = float(samples["host_time_s"][-1]) - before[1]
        if missing / self.nominal_rate_hz > elapsed_s + JUMP_ALLOWANCE_S:
            self._on_fault(f"{self._name}: its counter jumped by {missing} samples within {elapsed_s * 1e3:.0f} ms")

    def _time(self, samples: NDArray[Any]) -> None:
        self.last_s = float(samples["host_time_s"][-1])
        self.last_unix_s = self._clock.unix_s()
        self._total += len(samples)
        number = self._total if self._unwrapper is None else int(samples["counter"][-1])
        self._rate.append((self.last_s, self._total, self.last_s - number / self.nominal_rate_hz))

    def _receive(self, block: Block) -> None:
        if self._closing.is_set() or self._lost.is_set():
            return
        try:
            self.add(block)
        except Exception as error:  # a bug in a driver or here: report it at once, not after a timeout
            log.exception("the receiver of the %s failed", self._name)
            self._lose(f"{self._name}: internal: {type(error).__name__}: {error}")

    async def _watch_silence(self) -> None:
        silent_s = 0.0
        while True:
            began_s, newest_s = self._clock.now_s(), self.last_s
            if await self._tasks.sleep(LOOK_S, self._closing, self._lost):
                return
            looked_s = min(self._clock.now_s() - began_s, LONGEST_READ_S * self._clock.speed)
            silent_s = silent_s + looked_s if self.last_s == newest_s else 0.0  # frames that repeat are silence, too
            if silent_s > SILENCE_S * self._clock.speed:
                self._lose(f"{self._name} on {self._place}: silent for {SILENCE_S:g} s; {LOOK_AT}")

    def _lose(self, reason: str) -> None:
        if not (self._closing.is_set() or self._lost.is_set()):
            self._lost.set()
            self._ending = self._tasks.spawn(self._source.close(), f"{self._name} closing")
            self._on_lost(reason)

    async def _ended(self) -> None:
        """Wait until a device that was lost is closed: opened before, it would be closed for its next user."""
        if self._ending is not None:
            await self._tasks.wait(math.inf, self._ending.done)

"""One test, from the blocks of its growing journal: what can be sent by now, with times of LSL's clock.

The alignment is that of `rig.align`, of all samples so far. The sealed recording's uses the whole test. A line through
its first second errs most far away from it, so the first samples are held back until the line is known well enough.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import align, journal
from stimrig.rig.align import Array, Fit
from stimrig.rig.assembly import train_of_plan
from stimrig.rig.journal import Kind
from stimrig.rig.signals import SAMPLE

DELAY_S = 0.5
"""Real seconds for which each sample waits: longer than an ack may take, and than the rest that is measured after a
test's end."""
IN_TRANSIT_S = 0.1
"""Real seconds: edges and pulses newer than this are not compared, one of a pair may still be on its way."""
NO_SYNC = 255
GOOD_S, GOOD_SHARE = 0.0003, 0.1
"""Standard error of the alignment from which on samples are sent: s, or this share of a sample if that is longer."""
HOLD_S = 10.0
"""Real seconds for which the first samples are held at most until the alignment is good."""
UPDATE_S, UPDATE_SHARE = 0.5, 0.05
"""The alignment is fitted anew after so many real seconds, or this share of the test so far if that is longer."""
MARGIN_S = 0.005
"""Real seconds: the recording's first and last sample are decided by its final alignment; those near them are sent."""


@dataclass(slots=True)
class Batch:
    """What is to be sent, with LSL times (s): torque (N·m), pulses (width µs, current mA, index) and marks.

    `channels`: of each pulse, as a place in the rig file.
    """

    torque_s: Array = field(default_factory=lambda: np.empty(0))
    torque_nm: Array = field(default_factory=lambda: np.empty(0))
    pulse_s: list[float] = field(default_factory=list)
    pulses: list[tuple[float, float, int]] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)
    marks: list[tuple[float, dict[str, Any]]] = field(default_factory=list)


@dataclass(slots=True)
class _Pulse:
    width_us: float
    current_ma: float
    channel: int
    written_s: float = np.nan
    acked_s: float = np.nan


class LiveAlignment:
    """Grows with the test."""

    def __init__(self, sample_rate_hz: float, speed: float = 1.0) -> None:
        self._rate_hz, self._speed = sample_rate_hz, speed
        self._kind, self._counted, self._first_stamp_s = "", 0, 0.0
        self._taken: list[tuple[Array, NDArray[Any]]] = []
        self.written_s: list[float] = []
        """When each pulse was written, by the rig's clock."""
        self.fit: Fit | None = None
        self._synced = False

    def take(self, samples: NDArray[Any]) -> Array:
        """Take the next samples (`rig.signals.SAMPLE`); their times on the cell's clock, s."""
        cell_s = self._cell_s(samples)
        self._taken.append((cell_s, samples))
        return cell_s

    def update(self) -> None:
        cell_s, samples = (np.concatenate(parts) for parts in zip(*self._taken, strict=True))
        self._taken = [(cell_s, samples)]
        host_s, sync = samples["host_time_s"], samples["sync"]
        self._synced = bool(np.any(sync != NO_SYNC))
        until_s = float(host_s.max()) - IN_TRANSIT_S * self._speed
        self.fit = align.fit(cell_s, host_s, sync, np.array(self.written_s), self._rate_hz, until_s)

    def error_s(self, cell_s: float) -> float:
        """Standard error of the line at a time of the cell's clock, s; infinite where too little is known."""
        fit = self.fit
        span_s = 0.0 if fit is None else float(np.ptp(fit.cell_s))
        if fit is None or span_s <= 0 or (self._synced and fit.method != "sync"):
            return np.inf
        # the scatter of few points may be nothing by chance; a sample's length scatters at least
        least_s = 1 / self._rate_hz / np.sqrt(12 * len(fit.cell_s))
        lever = np.sqrt(12) * (cell_s - fit.line.centre_s) / span_s
        error_s = max(fit.line.error_s, least_s) * np.hypot(1, lever)
        return float(error_s) if np.isfinite(error_s) else np.inf

    def _cell_s(self, samples: NDArray[Any]) -> Array:
        """`rig.align.cell_time`, block by block: what the first block has tells what is counted by."""
        counter, stamp_s = samples["counter"], samples["stamp_s"]
        if not self._kind:
            self._kind = "counter" if np.all(counter >= 0) else "stamp" if np.all(np.isfinite(stamp_s)) else "count"
            self._first_stamp_s = float(stamp_s[0])
        if self._kind == "counter":
            return align.cell_time(counter.astype(np.int64), stamp_s, self._rate_hz)
        if self._kind == "stamp":
            return stamp_s - self._first_stamp_s
        cell_s = (self._counted + np.arange(len(samples))) / self._rate_hz
        self._counted += len(samples)
        return cell_s


class LiveTest:
    """Takes blocks, gives batches; knows no LSL and no files.

    `offset_s`: LSL's clock minus the machine's monotonic clock, s; `since_s`: only what came after it is sent, rig time
    (s): another process sent what was before; `sample_rate_hz`: used if the journal does not say it.
    """

    def __init__(self, offset_s: float = 0.0, since_s: float = -np.inf, sample_rate_hz: float = 1000.0) -> None:
        self._offset_s, self._since_s = offset_s, since_s
        self._rate_hz, self._speed = sample_rate_hz, 1.0
        self._header: dict[str, Any] = {}
        self._t0_s: float | None = None
        self._told = self.ended = False
        self._end: dict[str, Any] = {}
        self._alignment: LiveAlignment | None = None
        self._held: list[tuple[Array, NDArray[Any]]] = []
        self._pulses: dict[int, _Pulse] = {}
        self._good, self._updated_s, self._newest_s, self._last_s = False, -np.inf, -np.inf, -np.inf
        self.sent_samples = self.sent_pulses = 0

    def take(self, kind: Kind, payload: bytes) -> None:
        """Take the next block. Raises ValueError, KeyError, TypeError, struct.error: its content is not valid."""
        if kind == Kind.TORQUE:
            self._torque(np.frombuffer(payload, SAMPLE))
        elif kind in (Kind.INTENT, Kind.WRITTEN, Kind.SKIPPED, Kind.ACKED):
            self._pulse(kind, payload)
        elif kind == Kind.HEADER and not self._header:
            self._head(json.loads(payload))
        elif kind == Kind.START:
            self._t0_s = float(json.loads(payload)["t0_s"])
        elif kind == Kind.END:
            content = json.loads(payload)
            self._end, self.ended = {**content, "time_s": float(content["time_s"])}, True

    def ready(self, finish: bool = False) -> Batch:
        """What can be sent by now; with `finish` everything that is left."""
        batch, finish = Batch(), finish or self.ended
        if self._t0_s is None:
            return batch
        if not self._told:
            self._told = True
            batch.marks.append((self._lsl_s(self._t0_s), self._mark("start")))
        self._pass_pulses(batch, finish)
        self._align(finish)
        if self._good or finish:
            self._pass_torque(batch, finish)
        if self.ended:
            said = {"outcome": self._end.get("outcome"), "duration_s": self._end["time_s"] - self._t0_s}
            counts = {"samples_sent": self.sent_samples, "pulses_sent": self.sent_pulses}
            batch.marks.append((self._lsl_s(self._end["time_s"]), {**self._mark("end"), **said, **counts}))
        return batch

    def _head(self, header: dict[str, Any]) -> None:
        self._header = header
        self._rate_hz = float(header["sample_rate_hz"]) or self._rate_hz
        self._speed = float(header.get("configuration", {}).get("clock_speed", 1.0))

    def _torque(self, samples: NDArray[Any]) -> None:
        if len(samples) == 0:
            return
        if self._alignment is None:
            self._alignment = LiveAlignment(self._rate_hz, self._speed)
        self._held.append((self._alignment.take(samples), samples))
        self._newest_s = max(self._newest_s, float(samples["host_time_s"][-1]))

    def _pulse(self, kind: Kind, payload: bytes) -> None:
        index = struct.unpack_from("<i", payload)[0]
        if kind == Kind.INTENT:
            intent = journal.Intent.from_bytes(payload)
            self._pulses[index] = _Pulse(intent.pulse_width_us, intent.current_ma, intent.output)
            if self._t0_s is None and self._header:  # the block of the start is damaged
                self._t0_s = intent.due_s - train_of_plan(self._header["plan"]).due_s(index)
        elif kind == Kind.SKIPPED:
            self._pulses.pop(index, None)
        elif (pulse := self._pulses.get(index)) is None:
            return
        elif kind == Kind.WRITTEN:
            pulse.written_s = journal.WRITTEN.unpack(payload)[2]
        else:
            pulse.acked_s = journal.ACKED.unpack_from(payload)[1]

    def _mark(self, event: str) -> dict[str, Any]:
        plan = self._header.get("plan", {})
        names = {name: plan.get(name) for name in ("test_id", "participant", "kind")}
        return {"event": event, "recording_id": self._header.get("recording_id"), **names}

    def _pass_pulses(self, batch: Batch, finish: bool) -> None:
        """Pass on what was written and acknowledged, in order; an ack may still correct the time of writing."""
        for index in list(self._pulses):
            pulse = self._pulses[index]
            settled = finish or np.isfinite(pulse.acked_s) or self._newest_s > pulse.written_s + DELAY_S * self._speed
            unwritten = not np.isfinite(pulse.written_s)
            if unwritten and not finish and index == next(reversed(self._pulses)):
                return
            if not unwritten and not settled:
                return
            del self._pulses[index]
            if unwritten:  # its blocks are damaged, or the rig ended between intent and write
                continue
            written_s = min(pulse.written_s, pulse.acked_s) if np.isfinite(pulse.acked_s) else pulse.written_s
            if self._alignment is not None:
                self._alignment.written_s.append(written_s)
            if written_s >= self._since_s:
                batch.pulse_s.append(self._lsl_s(written_s))
                batch.pulses.append((pulse.width_us, pulse.current_ma, index))
                batch.channels.append(pulse.channel)
                self.sent_pulses += 1

    def _align(self, finish: bool) -> None:
        if self._alignment is None or not self._held:
            return
        played_s = self._newest_s - (self._t0_s or 0.0) if self._good else 0.0
        if not finish and self._newest_s < self._updated_s + max(UPDATE_S * self._speed, UPDATE_SHARE * played_s):
            return
        self._updated_s = self._newest_s
        self._alignment.update()
        first_s, last_s = float(self._held[0][0][0]), float(self._held[-1][0][-1])
        error_s = max(self._alignment.error_s(first_s), self._alignment.error_s(last_s))
        waited_s = self._newest_s - float(self._held[0][1]["host_time_s"][0])
        enough_s = max(GOOD_S * self._speed, GOOD_SHARE / self._rate_hz)
        self._good = self._good or error_s < enough_s or waited_s > HOLD_S * self._speed

    def _pass_torque(self, batch: Batch, finish: bool) -> None:
        if self._alignment is None or self._alignment.fit is None:
            return
        until_s = np.inf if finish else self._newest_s - DELAY_S * self._speed
        passing = 0
        while passing < len(self._held) and self._held[passing][1]["host_time_s"][-1] <= until_s:
            passing += 1
        if passing == 0:
            return
        cell_s = np.concatenate([held[0] for held in self._held[:passing]])
        samples = np.concatenate([held[1] for held in self._held[:passing]])
        del self._held[:passing]
        time_s = self._alignment.fit.line.at(cell_s)
        margin_s, begin_s = MARGIN_S * self._speed, self._t0_s or 0.0
        end_s = self._end["time_s"] if self.ended else np.inf
        keep = (time_s >= begin_s - margin_s) & (time_s < end_s + margin_s)
        keep &= samples["host_time_s"] >= self._since_s
        time_s = np.maximum.accumulate(np.maximum(time_s[keep], self._last_s))
        if len(time_s):
            self._last_s = float(time_s[-1])
        batch.torque_s, batch.torque_nm = self._lsl_s(time_s), samples["torque_nm"][keep]
        self.sent_samples += len(time_s)

    def _lsl_s(self, rig_s: Any) -> Any:
        return rig_s / self._speed + self._offset_s

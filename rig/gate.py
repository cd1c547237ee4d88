"""The only way to a stimulator: open only during a test, limits first, intent on disk before the command.

At most one pulse is unacknowledged at any time. Each pulse that comes due before the acknowledgement (ack) is dropped,
and the drop is recorded. So a stalled line can hold one pulse, never several. The moment at which that pulse is felt is
unknown until its ack is read. Intervals, rates and charge per second are therefore counted from the ack, so that they
hold at the electrode.

After `shut` has returned, no pulse is written to the line.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from stimrig.rig import journal as jn
from stimrig.rig.clock import Clock
from stimrig.rig.devices import Stimulator
from stimrig.rig.errors import DeviceError, JournalError
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.limits import Admitted, Limit, Refusal, admit, check
from stimrig.rig.signals import Ack, LateError, Pulse, PulseStatus

LATE_ACK_S = 0.015
"""Real seconds. A slower ack is noted in the recording: the pulse may have been felt that late, and at 40 pulses/s the
next one then follows too closely."""


@dataclass(frozen=True, slots=True)
class OnItsWay:
    """A pulse that was written to the line and that the device has not acknowledged."""

    index: int
    number: int
    pulse_width_us: float
    written_s: float


@dataclass(frozen=True, slots=True)
class Done:
    """Outcome of a pulse: its index, the width that was sent (0: none), the times when it was written and acknowledged
    (rig clock, s; NaN: not)."""

    index: int
    pulse_width_us: float
    written_s: float
    acknowledged_s: float
    status: PulseStatus


class Gate:
    """Owns the stimulator and sends admitted pulses.

    Parameters
    ----------
    stimulator
        The device. Nothing else keeps a reference to it.
    clock
        The rig's clock.
    on_fault, on_lost
        Called with the reason when the device reports an error, or when its line is gone.
    """

    def __init__(
        self,
        stimulator: Stimulator,
        clock: Clock,
        on_fault: Callable[[str], None],
        on_lost: Callable[[str], None],
    ) -> None:
        self._stimulator = stimulator
        self._clock = clock
        self._on_fault = on_fault
        self._journal: Journal | None = None
        self.is_open = False
        """True while a test may send pulses."""
        self._table: dict[str, Limit] = {}
        self.on_its_way: OnItsWay | None = None
        self._recent: deque[tuple[float, float]] = deque()
        self.last_pulse_s: float | None = None
        """Latest time at which the last pulse can have been felt, s; None before the first pulse."""
        self.lateness_s: list[float] = []
        self.ack_delay_s: list[float] = []
        self.charge_uc = 0.0
        self.dropped = 0
        self.done: list[Done] = []
        """In this order it became known; only appended to. A pulse that is on its way is not in it."""
        self._state_as_armed = ""
        stimulator.listen(self._acknowledged, on_lost)

    async def identify(self) -> dict[str, object]:
        """Open the line and ask the device for its identity. Raises DeviceError."""
        return await self._stimulator.open()

    async def state(self) -> tuple[bool, str]:
        """(True if the device says that it cannot stimulate, its state in words). Raises DeviceError."""
        return await self._stimulator.state()

    def reset(self) -> None:
        """Clear the counts of the previous test."""
        self.last_pulse_s, self.lateness_s, self.ack_delay_s = None, [], []
        self.charge_uc, self.dropped, self.done = 0.0, 0, []
        self._recent.clear()

    async def open(self, journal: Journal, table: dict[str, Limit], halted: Callable[[], bool]) -> None:
        """Arm the device for one test. It stays shut if the test is `halted` by the time that the device answers.

        Raises DeviceError, JournalError: the gate stays shut.
        """
        journal.append_json(Kind.EVENT, {"event": "arm", "time_s": self._clock.now_s()})
        await self._stimulator.arm()
        _, self._state_as_armed = await self._stimulator.state()
        self._table = table
        self.on_its_way = None  # the device has answered since, so the line is empty
        self._journal = journal
        self.is_open = not halted()

    def fire(self, index: int, pulse: Pulse, due_s: float, latest_s: float) -> PulseStatus:
        """Let one pulse through, or record why not.

        Parameters
        ----------
        index
            Its number in the test.
        due_s, latest_s
            When it is due, and the time after which it is dropped instead of sent.

        Raises
        ------
        DeviceError, JournalError
            No pulse may follow. The caller must stop the test.
        """
        journal = self._journal
        if journal is None or not self.is_open:
            return PulseStatus.REFUSED
        if pulse.pulse_width_us == 0:
            self._note(index, PulseStatus.REST)
            return PulseStatus.REST
        verdict = admit(pulse, self._table, self._stimulator.steps)
        if isinstance(verdict, Refusal):
            return self._skip(journal, index, PulseStatus.REFUSED, str(verdict))
        if verdict.pulse_width_us == 0 or verdict.current_ma == 0:
            return self._skip(journal, index, PulseStatus.REST)
        now_s = self._clock.now_s()
        if not (now_s <= latest_s):
            return self._skip(journal, index, PulseStatus.DROPPED)
        too_close = self._too_close(now_s)
        if too_close:
            return self._skip(journal, index, PulseStatus.DROPPED, too_close)
        refusal = self._too_much(now_s, verdict.charge_uc)
        if refusal is not None:
            return self._skip(journal, index, PulseStatus.REFUSED, str(refusal))
        return self._send(journal, index, verdict, now_s, due_s, latest_s)

    async def changed(self) -> str | None:
        """Return a change of the device's reports since it was armed; None: it is unchanged. Raises DeviceError."""
        try:
            _, state = await self._stimulator.state()
        except DeviceError:  # its answer may have come while the computer stood still again
            _, state = await self._stimulator.state()
        if state == self._state_as_armed:
            return None
        return f"stimulator: it is {state} after a pause of the computer, it was {self._state_as_armed}"

    def feed(self) -> None:
        """Feed the device's watchdog after a health check; does nothing unless a test runs. Raises DeviceError."""
        if self.is_open:
            self._stimulator.feed()

    def shut(self) -> None:
        """Write nothing more to the line. A pulse that it already holds stays in `on_its_way`."""
        self.is_open = False

    def release(self) -> None:
        """Shut, and release the test's journal: later acks are not recorded."""
        self.is_open = False
        self._journal = None

    async def stop(self) -> None:
        """Shut, discard what has not left this computer, and tell the device to stop. Raises DeviceError.

        The line keeps the order of bytes. A device that answers the stop has already received, or lost, the pulse
        that was sent before it.
        """
        self.shut()
        await self._stimulator.stop()
        if self.on_its_way is not None:
            self.on_its_way, self.last_pulse_s = None, self._clock.now_s()

    def still_possible(self) -> str:
        """A sentence if a pulse that was sent may still be felt; empty if not."""
        pulse = self.on_its_way
        if pulse is None:
            return ""
        age_ms = 1e3 * (self._clock.now_s() - pulse.written_s) / self._clock.speed
        return f"pulse {pulse.index + 1} was sent {age_ms:.0f} ms ago and not acknowledged: it may still be felt"

    async def disconnect(self) -> None:
        """Try to stop, then close the line; never raises."""
        with contextlib.suppress(DeviceError):
            await self.stop()
        self._stimulator.close()

    def _send(
        self, journal: Journal, index: int, pulse: Admitted, now_s: float, due_s: float, latest_s: float
    ) -> PulseStatus:
        """Intent to the journal, pulse to the line, then the counts."""
        journal.append(Kind.INTENT, jn.INTENT.pack(index, now_s, due_s, pulse.pulse_width_us, pulse.current_ma))
        try:
            number = self._stimulator.send(pulse, latest_s)  # checks the clock as its last step before the write
        except LateError:  # the disk or the line was slow
            return self._skip(journal, index, PulseStatus.DROPPED)
        written_s = self._clock.now_s()
        self.on_its_way = OnItsWay(index, number, pulse.pulse_width_us, written_s)
        self._recent.append((written_s, pulse.charge_uc))
        self.last_pulse_s = written_s
        self.lateness_s.append(written_s - due_s)
        self.charge_uc += pulse.charge_uc
        journal.append(Kind.WRITTEN, jn.WRITTEN.pack(index, number, written_s))
        return PulseStatus.UNACKNOWLEDGED

    def _skip(self, journal: Journal, index: int, status: PulseStatus, reason: str = "") -> PulseStatus:
        now_s = self._clock.now_s()
        journal.append(Kind.SKIPPED, jn.SKIPPED.pack(index, status, now_s))
        self._note(index, status)
        if status == PulseStatus.DROPPED:
            self.dropped += 1
        if reason:
            event = status.name.lower()
            journal.append_json(Kind.EVENT, {"event": event, "index": index, "reason": reason, "time_s": now_s})
        return status

    def _note(self, index: int, status: PulseStatus) -> None:
        """Record the outcome of a pulse that was not sent."""
        self.done.append(Done(index, 0.0, math.nan, math.nan, status))

    def _too_close(self, now_s: float) -> str:
        """Why too little time has certainly passed since the previous pulse; empty if enough has."""
        if self.on_its_way is not None:
            return f"pulse {self.on_its_way.index + 1} is not acknowledged yet"
        if not self._recent:
            return ""
        refusal = check(self._table["pulse_interval_s"], now_s - self._recent[-1][0])
        return "" if refusal is None else str(refusal)

    def _too_much(self, now_s: float, charge_uc: float) -> Refusal | None:
        while self._recent and self._recent[0][0] <= now_s - 1.0:
            self._recent.popleft()
        if self._recent:
            # pulses of the last second: a window that ends with a pulse may also begin with one
            refusal = check(self._table["pulse_rate_hz"], len(self._recent))
            if refusal is not None:
                return refusal
        return check(self._table["charge_per_second_uc"], charge_uc + sum(c for _, c in self._recent)) or check(
            self._table["charge_per_test_uc"], self.charge_uc + charge_uc
        )

    def _acknowledged(self, ack: Ack) -> None:
        pulse, index = self.on_its_way, -1
        unasked = ack.number >= 0 and ack.error is None and self.is_open
        if pulse is not None and pulse.number == ack.number:
            index, unasked = pulse.index, False
            self._settle(pulse, ack)
        failure = self._write_ack(index, ack, unasked)
        place = f" at pulse {index + 1}" if index >= 0 else ""
        for reason in (
            failure,
            f"stimulator: {ack.error}{place}" if ack.error is not None else "",
            "stimulator: it acknowledged a pulse that it was not sent; is the line disturbed?" if unasked else "",
        ):
            if reason:
                self._on_fault(reason)

    def _settle(self, pulse: OnItsWay, ack: Ack) -> None:
        """The ack came: the pulse was felt at some time between its write and its ack."""
        self.on_its_way = None
        self.last_pulse_s = max(ack.time_s, pulse.written_s)
        self.ack_delay_s.append(self.last_pulse_s - pulse.written_s)
        status = PulseStatus.ACKNOWLEDGED if ack.error is None else PulseStatus.DEVICE_ERROR
        self.done.append(Done(pulse.index, pulse.pulse_width_us, pulse.written_s, ack.time_s, status))
        if self._recent:
            self._recent[-1] = self.last_pulse_s, self._recent[-1][1]

    def _write_ack(self, index: int, ack: Ack, unasked: bool) -> str:
        try:
            if self._journal is not None:
                self._journal.append(Kind.ACKED, jn.ACKED.pack(index, ack.time_s) + (ack.error or "").encode())
                if unasked:
                    self._journal.append_json(Kind.EVENT, {"event": "unasked_ack", "time_s": ack.time_s})
                if index >= 0 and self.ack_delay_s[-1] > LATE_ACK_S * self._clock.speed:
                    late = {"event": "late_ack", "index": index, "delay_s": self.ack_delay_s[-1]}
                    self._journal.append_json(Kind.EVENT, {**late, "time_s": ack.time_s})
        except JournalError as error:
            return str(error)
        return ""

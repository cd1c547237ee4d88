"""The rig's states from one test to the next: a pure state machine.

    disconnected -> ready -> arming -> running -> sealing -> ready
                              |          |
                              +-> stopping -> sealing -> latched -> (a person) -> ready
    ready -> calibrating -> arming … sealing -> calibrating -> … -> ready

Every method returns a new `Phase` or raises the reason why it cannot. Only `rearm`, called by a person, leads out of
`latched` and `uncertain`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from stimrig.rig.errors import BusyError, DeviceError, LatchedError, RigError, UncertainError
from stimrig.rig.messages import RigState

BUSY: tuple[RigState, ...] = ("arming", "running", "sealing", "stopping")
NO_PREVIEW: tuple[RigState, ...] = ("calibrating", "arming", "running", "stopping")
"""No plan is previewed in these: the next pulse would wait for it."""
STOPPED: tuple[RigState, ...] = ("latched", "uncertain")
BEFORE = "; before: "
"""Between the reasons of several stops, the newest first."""
LONGEST_REASON = 2000
"""Characters that are kept of all of them: the newest stop's words are never cut."""


class TransitionError(RigError):
    """A step that is not allowed in this state: a bug in this program."""


@dataclass(frozen=True, slots=True)
class Phase:
    """State, its reason, and the test. `latch` and `lost` say which state follows the test."""

    state: RigState = "disconnected"
    reason: str = "not connected yet"
    test_id: str | None = None
    participant: str | None = None
    latch: bool = False
    lost: str = ""
    calibrating: bool = False

    @property
    def reason_stopped(self) -> str:
        """Why it is stopped, and which device is gone, in words."""
        return self.reason if self.lost in self.reason else f"{self.reason}; {self.lost}".lstrip("; ")

    @property
    def busy(self) -> bool:
        """True while a test is in progress: its devices and files are in use."""
        return self.state in BUSY

    def connected(self, before: RigState | None = None, reason: str = "") -> Phase:
        """Both devices answer. `before`: the rig's state when its last process ended, from the latch file."""
        self._only("disconnected")
        if before == "latched":
            return Phase("latched", reason)
        if before is not None:
            return Phase("uncertain", reason)
        return Phase("ready", "")

    def disconnected(self, reason: str) -> Phase:
        """A device is gone: takes effect at once when idle, else after the test; a latch stays."""
        if self.busy or self.state in STOPPED:
            return replace(self, lost=reason)
        return Phase("disconnected", reason)

    def start(self, test_id: str, participant: str) -> Phase:
        """A person asks for a test.

        Raises BusyError, LatchedError, UncertainError, DeviceError: naming the holder or the reason.
        """
        self.may_start()
        return Phase("arming", "", test_id, participant)

    def calibrate(self, participant: str) -> Phase:
        """A person opens a guided calibration. Raises as `start` does."""
        self.may_start()
        return Phase("calibrating", "", None, participant, calibrating=True)

    def train(self, test_id: str) -> Phase:
        """One train of the open calibration."""
        self._only("calibrating")
        return replace(self, state="arming", test_id=test_id)

    def may_start(self) -> None:
        """Raise what forbids a start now (see `start`)."""
        if self.busy:
            raise BusyError(f"test {self.test_id} of participant {self.participant} is {self.state}; wait or stop it")
        if self.state == "calibrating":
            raise BusyError(f"a calibration of participant {self.participant} is open; finish or discard it")
        if self.state == "latched":
            raise LatchedError(f"{self.reason}; look at the participant and the rig, then re-arm")
        if self.state == "uncertain":
            raise UncertainError(f"{self.reason}; look at the participant and the rig, then re-arm")
        if self.state == "disconnected":
            raise DeviceError(f"{self.reason}; correct that, then re-arm")

    def armed(self) -> Phase:
        """The device is ready for the first pulse."""
        self._only("arming")
        return replace(self, state="running")

    def halted(self, reason: str) -> Phase:
        """A stop or a fault, at any time: an idle rig latches at once, also without devices; a test is ended first.

        Where it is stopped already, both reasons are told: the later one may be the one that matters.
        """
        if self.state in ("ready", "calibrating"):
            return Phase("latched", reason)
        if self.state == "disconnected":
            return Phase("latched", reason, lost=self.reason)
        earlier = (part for part in self.reason.split(BEFORE) if part not in ("", reason))
        all_reasons = BEFORE.join((reason, *earlier))[:LONGEST_REASON]
        state = "stopping" if self.state in ("arming", "running") else self.state
        return replace(self, state=state, reason=all_reasons, latch=self.busy)

    def withdrawn(self) -> Phase:
        """The test is ended without a latch: nothing is wrong."""
        self._only("arming", "running")
        return replace(self, state="stopping")

    def ended(self) -> Phase:
        """Stimulation is over; the recording is being sealed."""
        self._only("running", "stopping", "arming")
        return replace(self, state="sealing")

    def sealed(self) -> Phase:
        """The recording is sealed (or its journal is kept)."""
        self._only("sealing")
        if self.latch:
            return Phase("latched", self.reason, lost=self.lost)
        if self.lost:
            return Phase("disconnected", self.lost)
        if self.calibrating:
            return replace(self, state="calibrating", test_id=None)
        return Phase("ready", "")

    def calibrated(self) -> Phase:
        self._only("calibrating")
        return Phase("ready", "")

    def rearm(self) -> Phase:
        """A person has checked participant and rig, and both devices have just answered.

        Raises BusyError: a test is in progress, or a calibration is open.
        """
        if self.busy:
            raise BusyError(f"test {self.test_id} is {self.state}; nothing to re-arm")
        if self.state == "calibrating":
            raise BusyError(f"a calibration of participant {self.participant} is open; nothing to re-arm")
        return Phase("ready", "")

    def _only(self, *states: RigState) -> None:
        if self.state not in states:
            raise TransitionError(f"the rig is {self.state}, this step needs {' or '.join(states)}")

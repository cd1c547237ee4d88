"""The rig's exceptions. Its socket (`rig.control`) and command line (`rig.__main__`) turn them into messages."""

from __future__ import annotations


class RigError(Exception):
    """Base of all: the text is one line that names the place and says how to correct it.

    `code` is stable and goes to clients as `messages.Problem.code`.
    """

    code = "internal"
    title = "The rig could not do that"


class ConfigError(RigError):
    """The rig file is wrong: names the key and what would be right."""

    code = "bad-config"
    title = "The rig file is wrong"


class PlanError(RigError):
    """A test plan cannot be built: names the segment and the setting."""

    code = "bad-plan"
    title = "The test plan is wrong"


class RefusedError(RigError):
    """A pulse or plan is outside a limit: names the limit, the value and the bound."""

    code = "refused"
    title = "Refused by a limit"


class RestError(RefusedError):
    """Too soon after the last pulse: says how long to wait, so that a program can ask again."""

    code = "rest-needed"
    title = "The muscle has to rest first"


class BusyError(RigError):
    """A test is running: names it."""

    code = "busy"
    title = "The rig is busy"


class TooLateError(RigError):
    """An answer to something that has passed: a boundary that was laid meanwhile, a test that is ending."""

    code = "late"
    title = "Too late"


class LatchedError(RigError):
    """Stopped after a fault or a stop, and no person has re-armed yet."""

    code = "latched"
    title = "The rig is stopped until a person re-arms it"


class LatchChangedError(RigError):
    """The rig was stopped since who asks has looked: says what the stop is now."""

    code = "latch-changed"
    title = "The rig was stopped meanwhile"


class WithdrawnError(RigError):
    """What the test was allowed on is no longer so: it does not begin."""

    code = "withdrawn"
    title = "The test was withdrawn"


class UncertainError(RigError):
    """Started after a crash during a test, and no person has re-armed yet."""

    code = "uncertain"
    title = "The rig died in a test and waits for a person"


class DeviceError(RigError):
    """A device cannot be reached, does not answer, or answered with an error."""

    code = "disconnected"
    title = "A device does not answer"


class JournalError(RigError):
    """The journal could not be written (disk full, I/O error): stimulation stops."""

    code = "journal"
    title = "The journal could not be written"


class RecordingError(RigError):
    """A recording could not be sealed or read back; the journal is kept."""

    code = "recording"
    title = "The recording could not be sealed"


class WireError(DeviceError):
    """Bytes that are not a valid frame of the protocol: names the rule that is broken."""

    code = "wire"
    title = "The device sent invalid data"

"""The rig's exceptions. The socket (`rig.control`) and the command line (`rig.__main__`) turn them into messages."""

from __future__ import annotations


class RigError(Exception):
    """Base of all: the text is one line that names the place and says how to correct it.

    `code` is stable and goes to clients as `messages.Problem.code`.
    """

    code, title = "internal", "The rig could not do that"

    def __init_subclass__(cls, code: str = "", title: str = "") -> None:
        cls.code, cls.title = code or cls.code, title or cls.title


class ConfigError(RigError, code="bad-config", title="The rig file is wrong"):
    """Names the key and what would be right."""


class PlanError(RigError, code="bad-plan", title="The test plan is wrong"):
    """A test plan cannot be built: names the segment and the setting."""


class RefusedError(RigError, code="refused", title="Refused by a limit"):
    """A pulse or plan is outside a limit: names the limit, the value and the bound."""


class RestError(RefusedError, code="rest-needed", title="The muscle has to rest first"):
    """Too soon after the last pulse: says how long to wait, so that a program can ask again."""


class BusyError(RigError, code="busy", title="The rig is busy"):
    """A test is running: names it."""


class TooLateError(RigError, code="late", title="Too late"):
    """An answer to something that has passed: a boundary that was laid meanwhile, a test that is ending."""


class LatchedError(RigError, code="latched", title="The rig is stopped until a person re-arms it"):
    """Stopped after a fault or a stop, and no person has re-armed yet."""


class LatchChangedError(RigError, code="latch-changed", title="The rig was stopped meanwhile"):
    """The rig was stopped since who asks has looked: says what the stop is now."""


class WithdrawnError(RigError, code="withdrawn", title="The test was withdrawn"):
    """The conditions under which the test was allowed have changed: it does not begin."""


class UncertainError(RigError, code="uncertain", title="The rig died in a test and waits for a person"):
    """Started after a crash during a test, and no person has re-armed yet."""


class DeviceError(RigError, code="disconnected", title="A device does not answer"):
    """A device cannot be reached, does not answer, or answered with an error."""


class JournalError(RigError, code="journal", title="The journal could not be written"):
    """Disk full, I/O error: stimulation stops."""


class RecordingError(RigError, code="recording", title="The recording could not be sealed"):
    """A recording could not be sealed or read back; the journal is kept."""


class WireError(DeviceError, code="wire", title="The device sent invalid data"):
    """Bytes that are not a valid frame of the protocol: names the rule that is broken."""

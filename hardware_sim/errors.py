"""One exception tree for the emulator; mapped to one line on standard error in `__main__`."""

from __future__ import annotations


class HardwareSimError(Exception):
    """Base of everything the emulator raises on purpose; its text names the place and the remedy."""


class PatientError(HardwareSimError):
    """A patient, its file or one of its parameters cannot be used."""


class SettingsError(HardwareSimError):
    """A setting of the emulator is out of its range."""


class FaultError(HardwareSimError):
    """A fault of that name does not exist, or its settings make no sense."""


class ArmError(HardwareSimError):
    """The arm cannot be moved so, or its description makes no sense."""

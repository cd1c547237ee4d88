"""The emulator's only exception; mapped to one line on standard error in `__main__`."""

from __future__ import annotations


class HardwareSimError(Exception):
    """A setting, patient, arm or fault cannot be used; the text names the place and the remedy."""

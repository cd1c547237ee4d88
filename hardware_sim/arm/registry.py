"""Movers by name, made with settings that the control line or a file gives."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any

from stimrig.hardware_sim.arm import movers
from stimrig.hardware_sim.arm.motion import Begin, MoverProtocol
from stimrig.hardware_sim.errors import ArmError
from stimrig.hardware_sim.scan import modules_with


def modes() -> list[str]:
    """Names of all movers, in alphabetical order."""
    return list(modules_with(movers, "Mover"))


def make(mode: str, begin: Begin, settings: Mapping[str, Any]) -> MoverProtocol:
    """The named mover.

    Raises
    ------
    ArmError
        There is no such mover, or it has no such setting, or a value makes no sense.
    """
    modules = modules_with(movers, "Mover")
    if mode not in modules:
        raise ArmError(f"unknown mode of the arm {mode!r}; there are {', '.join(modules)}")
    mover = modules[mode].Mover
    known = list(inspect.signature(mover).parameters)[1:]
    for key, value in settings.items():
        if key not in known:
            raise ArmError(f"mode '{mode}' of the arm has no setting '{key}'; it has {', '.join(known) or 'none'}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ArmError(f"the arm's '{key}' must be a finite number, not {value!r}")
    return mover(begin, **settings)

"""The library of protocols: whole tests, each a fixed list of segments in one file, found by looking into this folder.

A protocol is a module with a docstring, whose first sentence says what it is, and a function
`segments(max_pulse_width_us) -> list[SegmentPlan]`: the segments for a largest width in µs. The module's name is the
protocol's id. To add a protocol, add a file. `DEFAULT` is the pre-session test of a plan that names nothing else.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from functools import cache
from typing import Protocol, cast

from stimrig.rig.errors import PlanError
from stimrig.rig.messages import SegmentPlan

DEFAULT = "paper"


class TestProtocol(Protocol):
    """Interface of a module in this folder."""

    __test__ = False

    @staticmethod
    def segments(max_pulse_width_us: float) -> list[SegmentPlan]: ...


@cache
def library() -> dict[str, TestProtocol]:
    """Every protocol by its id; the default is the first."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))
    names.sort(key=lambda name: name != DEFAULT)
    return {name: cast(TestProtocol, importlib.import_module(f"{__name__}.{name}")) for name in names}


def segments(protocol_id: str, max_pulse_width_us: float) -> list[SegmentPlan]:
    """Segments of the protocol of that id.

    Raises
    ------
    PlanError
        There is no protocol of that id; the message lists the known ones.
    """
    if protocol_id not in library():
        raise PlanError(f"protocol {protocol_id!r} is unknown; use one of {', '.join(library())}")
    return library()[protocol_id].segments(max_pulse_width_us)


def described() -> dict[str, str]:
    """What each protocol's file says of it, by id."""
    return {
        name: " ".join((inspect.getdoc(protocol) or "").partition("\n\n")[0].split())
        for name, protocol in library().items()
    }

"""Hears everything that the load cell sends, beside the rig: also what the rig leaves out, such as repeated samples."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.machine import Bus, Listener, Machine
from stimrig.rig.signals import SAMPLE, Block


class Heard:
    """A stretch of what was heard.

    `samples`: dtype `SAMPLE`, in the order of arrival, with the raw counter; `errors`: error frames of the bus;
    `malformed`: frames that do not fit the description.
    """

    def __init__(self, blocks: list[Block]) -> None:
        parts = [block.samples for block in blocks if len(block)]
        self.samples: NDArray[Any] = np.concatenate(parts) if parts else np.empty(0, SAMPLE)
        self.errors = sum(block.error_frames for block in blocks)
        self.malformed = sum(block.malformed for block in blocks)

    def steps(self, modulus: int) -> NDArray[np.int64]:
        """From each sample's number to the next, by a counter that wraps at `modulus`."""
        return np.diff(self.samples["counter"]) % modulus

    @property
    def edges(self) -> int:
        """How often the stimulator's sync line rose."""
        sync = self.samples["sync"]
        return int(np.sum((sync[1:] == 1) & (sync[:-1] != 1)))


class Ears:
    """A machine like the one it is made of, whose load cell is heard."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._blocks: list[Block] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._machine, name)

    def as_machine(self) -> Machine:
        """Itself, for who needs a machine."""
        return cast("Machine", self)

    def open_bus(self, arguments: dict[str, Any], name: str) -> Bus:
        """See `Machine.open_bus`."""
        return cast("Bus", _Tapped(self._machine.open_bus(arguments, name), self._blocks))

    def now(self) -> int:
        """A place to listen from."""
        return len(self._blocks)

    def since(self, place: int) -> Heard:
        return Heard(self._blocks[place:])


class _Tapped:
    """A bus whose first listener, the load cell, is heard."""

    def __init__(self, bus: Bus, blocks: list[Block]) -> None:
        self._bus, self._blocks = bus, blocks
        self._taps: list[tuple[Listener, Listener]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def listen(self, listener: Listener) -> None:
        def take(block: Block) -> None:
            self._blocks.append(block)
            listener.take(block)

        tap = listener if self._taps else listener._replace(take=take)
        self._taps.append((listener, tap))
        self._bus.listen(tap)

    def leave(self, listener: Listener) -> None:
        for own, tap in self._taps:
            if own is listener:
                self._bus.leave(tap)

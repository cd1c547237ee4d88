"""The only way to a switch: its relays never move while a pulse may flow.

They are set before the gate opens, and opened once the stimulator's stop is confirmed. A relay that moves under current
draws an arc, and the current jumps to other places of the skin.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

from stimrig.rig.clock import Clock
from stimrig.rig.devices import Switch
from stimrig.rig.errors import DeviceError, JournalError
from stimrig.rig.gate import Gate
from stimrig.rig.journal import Journal, Kind


class Relays:
    """Owns the switch. `gate`: of the stimulator that feeds it."""

    def __init__(self, switch: Switch, gate: Gate, clock: Clock) -> None:
        self._switch, self._gate, self._clock = switch, gate, clock
        self.identity: dict[str, Any] = {}

    async def open(self, on_lost: Callable[[str], None]) -> None:
        """Open the line and all relays; the stimulator must be stopped. Raises DeviceError."""
        self._refuse_current()
        self.identity = await self._switch.open(on_lost)
        await self.open_all()

    async def connect(self, elements: tuple[int, ...], journal: Journal) -> None:
        """Connect these elements for a test; what is to be done is in the journal before it is done.

        Raises DeviceError, JournalError: the test must not begin.
        """
        self._refuse_current()
        self._note(journal, "relays", elements)
        await self._switch.connect(elements)
        self._note(journal, "relays_set", elements)

    async def open_all(self, journal: Journal | None = None) -> None:
        """Disconnect every element. Raises DeviceError: they may be connected still."""
        self._refuse_current()
        await self._switch.open_all()
        if journal is not None:
            with contextlib.suppress(JournalError):  # the test ends anyway
                self._note(journal, "relays_open", ())

    def close(self) -> None:
        """Close the line; never raises. The relays stay as they are."""
        self._switch.close()

    def _refuse_current(self) -> None:
        if self._gate.is_open or self._gate.on_its_way is not None:
            raise DeviceError("switch: relays must not move while a pulse may flow; they were left as they are")

    def _note(self, journal: Journal, event: str, elements: tuple[int, ...]) -> None:
        content = {"event": event, "elements": list(elements), "time_s": self._clock.now_s()}
        journal.append_json(Kind.EVENT, content)

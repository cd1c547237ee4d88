"""The control line for tests: a Unix socket with one JSON object per line each way. It is no part of the rig.

Commands: `{"cmd": "state"}`, `{"cmd": "pulses", "since": 0}`, `{"cmd": "faults"}` (lists them),
`{"cmd": "fault", "name": …, "on": true, "for_s": …, <settings>}`, and where there is an arm
`{"cmd": "arm", "mode": …, <settings of the mode>}`. Answers carry `"ok"`; if it is false, `"error"`.
"""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.ports import Client, Reactor, Server
from stimrig.hardware_sim.timeline import WallClock

LONGEST_LINE = 65536


class Control(Server):
    """Answers any number of clients, in the emulator's own thread; `catch_up` simulates up to the present first."""

    def __init__(
        self,
        reactor: Reactor,
        path: Path,
        devices: Devices,
        clock: WallClock,
        catch_up: Callable[[], None],
        state: Callable[[], dict[str, Any]],
    ) -> None:
        self.path = path
        self._devices, self._clock, self._catch_up = devices, clock, catch_up
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(str(path))
        listener.listen()
        super().__init__(reactor, listener, self._obey)
        self._commands: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "state": lambda _request: state(),
            "pulses": self._pulses,
            "faults": lambda _: {"faults": devices.faults.describe(), "active": devices.faults.active()},
            "fault": self._fault,
            "arm": self._arm,
        }

    def answer(self, line: bytes) -> dict[str, Any]:
        """The answer to one line."""
        try:
            request = json.loads(line)
            command = request.pop("cmd")
        except (ValueError, AttributeError, KeyError, TypeError):
            return {"ok": False, "error": 'expected one JSON object a line with "cmd"'}
        if command not in self._commands:
            known = ", ".join(self._commands)
            return {"ok": False, "error": f"unknown command {command!r}; there are {known}"}
        self._catch_up()
        try:
            return {"ok": True, **self._commands[command](request)}
        except HardwareSimError as error:
            return {"ok": False, "error": str(error)}

    def _obey(self, client: Client) -> None:
        *lines, rest = client.received.split(b"\n")
        client.received = rest[-LONGEST_LINE:]
        for line in lines:
            client.backlog += json.dumps(self.answer(line)).encode() + b"\n"

    def _now(self) -> dict[str, float]:
        """The emulated time, and the machine's monotonic time then."""
        time_s = self._devices.timeline.now_s
        return {"time_s": time_s, "monotonic_s": self._clock.monotonic_s(time_s)}

    def _pulses(self, request: dict[str, Any]) -> dict[str, Any]:
        since = request.get("since", 0)
        pulses = self._devices.electrodes.pulses(since if isinstance(since, int) and since >= 0 else 0)
        for pulse in pulses:
            pulse["monotonic_s"] = self._clock.monotonic_s(pulse["time_s"])
        return {"pulses": pulses}

    def _fault(self, request: dict[str, Any]) -> dict[str, Any]:
        name, on, for_s = str(request.pop("name", "")), request.pop("on", True), request.pop("for_s", None)
        if for_s is not None and not (isinstance(for_s, int | float) and 0 <= for_s < math.inf):
            raise HardwareSimError(f"'for_s' must be a number of seconds, not {for_s!r}")
        faults = self._devices.faults
        if on:
            faults.on(name, request, for_s)
        else:
            faults.off(name)
        return {**self._now(), "active": faults.active(), "pulses_received": len(self._devices.electrodes.log)}

    def _arm(self, request: dict[str, Any]) -> dict[str, Any]:
        limb = self._devices.limb
        if limb is None:
            raise HardwareSimError("this rig has no arm; start it with --arm")
        limb.move(str(request.pop("mode", "")), request, self._devices.timeline.now_s)
        return {**self._now(), **limb.state()}

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
from stimrig.hardware_sim.errors import ArmError, FaultError, HardwareSimError
from stimrig.hardware_sim.ports import Reactor
from stimrig.hardware_sim.timeline import WallClock

LONGEST_LINE = 65536
SEND_TIMEOUT_S = 1.0


class Control:
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
        self._reactor, self._devices, self._clock, self._catch_up = reactor, devices, clock, catch_up
        self._clients: dict[socket.socket, bytes] = {}
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        self._listener.setblocking(False)
        reactor.add(self._listener, self._accept)
        self._commands: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "state": lambda _request: state(),
            "pulses": self._pulses,
            "faults": lambda _: {"faults": devices.faults.describe(), "active": devices.faults.active()},
            "fault": self._fault,
            "arm": self._arm,
        }

    def close(self) -> None:
        """Close the socket and every connection."""
        for client in list(self._clients):
            self._drop(client)
        self._reactor.remove(self._listener)
        self._listener.close()

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

    def _pulses(self, request: dict[str, Any]) -> dict[str, Any]:
        since = request.get("since", 0)
        pulses = self._devices.electrodes.pulses(since if isinstance(since, int) and since >= 0 else 0)
        for pulse in pulses:
            pulse["monotonic_s"] = self._clock.monotonic_s(pulse["time_s"])
        return {"pulses": pulses}

    def _fault(self, request: dict[str, Any]) -> dict[str, Any]:
        name, on, for_s = request.pop("name", ""), request.pop("on", True), request.pop("for_s", None)
        if for_s is not None and not (isinstance(for_s, int | float) and 0 <= for_s < math.inf):
            raise FaultError(f"'for_s' must be a number of seconds, not {for_s!r}")
        if on:
            self._devices.faults.on(str(name), request, for_s)
        else:
            self._devices.faults.off(str(name))
        time_s = self._devices.timeline.now_s
        return {
            "time_s": time_s,
            "monotonic_s": self._clock.monotonic_s(time_s),
            "active": self._devices.faults.active(),
            "pulses_received": len(self._devices.electrodes.log),
        }

    def _arm(self, request: dict[str, Any]) -> dict[str, Any]:
        limb, time_s = self._devices.limb, self._devices.timeline.now_s
        if limb is None:
            raise ArmError("this rig has no arm; start it with --arm")
        limb.move(str(request.pop("mode", "")), request, time_s)
        return {"time_s": time_s, "monotonic_s": self._clock.monotonic_s(time_s), **limb.state()}

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        client.settimeout(SEND_TIMEOUT_S)
        self._clients[client] = b""
        self._reactor.add(client, lambda: self._read(client))

    def _read(self, client: socket.socket) -> None:
        try:
            data = client.recv(LONGEST_LINE)
            *lines, rest = (self._clients[client] + data).split(b"\n")
            self._clients[client] = rest[-LONGEST_LINE:]
            for line in lines:
                client.sendall(json.dumps(self.answer(line)).encode() + b"\n")
        except OSError:  # the client has gone or does not read; it must not block the emulator
            data = b""
        if not data:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        if self._clients.pop(client, None) is not None:
            self._reactor.remove(client)
            client.close()

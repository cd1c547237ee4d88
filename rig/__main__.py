"""`python -m stimrig.rig`: the process that owns the devices.

It prints one JSON line on standard output when its socket is ready, and logs to standard error. If it has a terminal,
any key in it stops stimulation. It runs until SIGTERM or SIGINT: then it stops stimulation, confirms the stop, seals
the recording and exits 0. Exit 2: an error in the rig file.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ctypes
import json
import logging
import os
import resource
import signal
import socket
import sys
from collections.abc import Mapping
from pathlib import Path

from stimrig.rig import config as configuration
from stimrig.rig import devices, logs
from stimrig.rig.adapters.machine import LocalMachine
from stimrig.rig.adapters.server import Server, Submit
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import RigError
from stimrig.rig.keys import StopKey
from stimrig.rig.messages import stop_socket


class Notifier:
    """Sends messages to the service manager that started this process; never blocks, never raises.

    One datagram for each (systemd, sd_notify(3)). Without systemd (no NOTIFY_SOCKET) nothing is sent.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address  # @: an abstract socket
        is_for_this_process = environment.get("WATCHDOG_PID", str(os.getpid())) == str(
            os.getpid()
        )  # else it was a parent's
        self.watched = bool(address) and is_for_this_process and environment.get("WATCHDOG_USEC", "").isdigit()
        self._complained = False

    def ready(self) -> None:
        """The socket answers and both devices have been tried."""
        self._send("READY=1")

    def alive(self, trouble: str | None) -> None:
        """Feed the watchdog if all is well; else report what is wrong, and let the watchdog expire.

        `trouble`: what `Rig.trouble` found; None: nothing.
        """
        if trouble is None:
            if self._complained:
                self._send("STATUS=")
            self._complained = False
            if self.watched:
                self._send("WATCHDOG=1")
        elif not self._complained:
            self._complained = True
            self._send(f"STATUS=not fed: {trouble}")

    def stopping(self) -> None:
        """The rig stops stimulation and seals the recording."""
        self._send("STOPPING=1")

    def _send(self, words: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
            line.setblocking(False)
            line.sendto(words.encode(), self._address)


log = logging.getLogger("rig")

SWITCH_INTERVAL_S = 0.0005
"""Longest time that a thread keeps the interpreter while the sender waits; Python's default is 5 ms."""
PROCESS_PRIORITY = 10
LOCK_ALL = 1 | 2 | 4
"""Flags of mlockall: present pages, future pages, each page once it is touched."""
HUNG_S = 5.0
"""Real seconds after which the rig's thread counts as hung."""
BEAT_PERIOD_S = 0.5
"""Period at which the process checks its parent and its own threads, s (see WatchdogSec in deploy/)."""


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    logs.configure("rig", logging.DEBUG if options.verbose else logging.INFO)
    try:
        overrides = {"data_dir": options.data, "socket": options.socket, "clock_speed": options.clock_speed}
        config = configuration.chosen(options, **overrides)
        if options.check:
            _check(config)
            return 0
        asyncio.run(_serve(config, os.getppid() if options.die_with_parent else None))
    except RigError as error:
        print(f"rig: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m stimrig.rig", description="The process that owns the rig's devices."
    )
    configuration.add_arguments(parser)
    parser.add_argument("--socket", type=Path, help="Unix socket to listen on; overrides the rig file")
    parser.add_argument("--data", type=Path, help="folder for journals and recordings; overrides the rig file")
    parser.add_argument("--clock-speed", type=float, help="with --emulator-json only: rig seconds per real second")
    parser.add_argument("--check", action="store_true", help="check the rig file and the DBC, then exit")
    parser.add_argument("--die-with-parent", action="store_true", help="end as on SIGTERM when the parent has died")
    parser.add_argument("--verbose", action="store_true")
    return parser


def _check(config: configuration.RigConfig) -> None:
    """Create the devices without opening them; this reads the DBC, too."""
    machine, chosen = LocalMachine(MonotonicClock(config.clock_speed)), config.devices()
    for kind, settings in chosen.items():
        devices.find(kind, settings.device).create(settings, machine)
    print(json.dumps({"ok": True, **{kind: settings.device for kind, settings in chosen.items()}}))


async def _serve(config: configuration.RigConfig, parent: int | None) -> None:
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PROCESS_PRIORITY))
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY or os.geteuid() == 0:
        ctypes.CDLL(None).mlockall(LOCK_ALL)  # what was touched stays in memory; within a limit later memory would fail
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    server, notifier = Server(), Notifier()
    if not config.require_calibration:
        log.warning("require_calibration is false: tests start without a calibration; connect no person to this rig")
    machine = LocalMachine(MonotonicClock(config.clock_speed))
    submit = machine.driver.submit
    rig = Rig(config, machine, server.publish)
    await asyncio.wrap_future(submit(rig.open))
    await server.start(rig, submit, config.socket)
    print(json.dumps({"socket": str(config.socket), "state": rig.status().state}), flush=True)
    notifier.ready()
    with StopKey(lambda: submit(lambda: _stop_by_key(rig))) as key:
        if key.watched:
            log.info("any key in this terminal stops stimulation; Ctrl-C ends the rig")
        while not stop.is_set() and parent in (None, os.getppid()):
            notifier.alive(await _trouble(rig, submit))
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), BEAT_PERIOD_S)
    log.info("asked to end")
    notifier.stopping()
    await asyncio.wrap_future(submit(rig.close))
    await server.close()
    machine.driver.end()
    for path in (config.socket, stop_socket(config.socket)):
        path.unlink(missing_ok=True)


async def _trouble(rig: Rig, submit: Submit) -> str | None:
    """Return `Rig.trouble`, or that the rig's own thread does not answer. Then the watchdog is not fed."""

    async def check() -> str | None:
        return rig.trouble()

    try:
        return await asyncio.wait_for(asyncio.wrap_future(submit(check)), HUNG_S)
    except TimeoutError:
        return f"the rig's thread hangs: no answer for {HUNG_S:g} s"


async def _stop_by_key(rig: Rig) -> None:
    evidence = await rig.stop("a key in the terminal", "operator")
    log.info("stop by key: %s, %s", "confirmed" if evidence.confirmed else "NOT CONFIRMED", evidence.detail)


if __name__ == "__main__":
    sys.exit(main())

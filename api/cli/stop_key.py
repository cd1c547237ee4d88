"""Any key stops: while a test runs and a person sits at the terminal, a key sends the stop straight to the rig."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

import httpx

from stimrig.rig import keys
from stimrig.rig.messages import StopEvidence
from stimrig.rig.requests import StatusRequest, StopRequest

REASON, BY = "a key was pressed", "terminal"
IDLE = ("ready", "latched", "disconnected")
"""Nothing is played and no calibration is open: a stray key must not latch the rig."""
STATUS_S, STOP_S, HEARD_S = 0.5, 8.0, 2.0
CONFIRMED, NOTHING = "stopped: the rig confirms that stimulation is off", "no test runs, nothing to stop"
NOT_CONFIRMED = "THE STOP IS NOT CONFIRMED. Use the stimulator's own emergency switch now."


class StopKey(keys.StopKey):
    """Listens for a key as long as it is open; does nothing where standard input is no terminal.

    `stop`: stops, and says in words what came of it; `tell`: gets the words; `descriptor`: another file descriptor than
    standard input's.
    """

    def __init__(self, stop: Callable[[], str], report: Callable[[str], object], descriptor: int | None = None) -> None:
        self.stop, self.report = stop, report
        super().__init__(self._press, standard_input() if descriptor is None else descriptor, in_foreground)

    def _press(self) -> None:
        try:
            self.report(self.stop())
        except Exception as error:
            self.report(f"{NOT_CONFIRMED} ({type(error).__name__}: {error})")


def standard_input() -> int:
    """Return its descriptor, or -1 where it has none."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return -1


def in_foreground(descriptor: int) -> bool:
    """Tell whether it is a terminal whose keys are for this program."""
    try:
        return os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:  # not the controlling terminal: it has no foreground process group
        return True


def at_rig(path: Path, stray: Callable[[], bool] = lambda: True) -> Callable[[], str]:
    """Return what stops the rig at a socket, past the service: it need not be alive.

    `stray`: whether a key may be a stray one while the rig plays nothing. A program that has asked for a test says no:
    the key is to stop what is about to begin.
    """
    from stimrig.api.clock import Clock
    from stimrig.api.errors import ApiError
    from stimrig.api.sessions.rig_client import RigClient

    async def stop() -> str:
        rig = RigClient(path, Clock())
        with contextlib.suppress(Exception):  # a rig without a readable state is stopped
            if stray() and (await rig.ask(StatusRequest(), STATUS_S)).get("state") in IDLE:
                return NOTHING
        try:
            evidence = await rig.ask_for(StopEvidence, StopRequest(reason=REASON, by=BY), STOP_S)
        except ApiError as error:
            return f"{NOT_CONFIRMED} {error.title}: {error.detail}"
        return CONFIRMED if evidence.confirmed else f"{NOT_CONFIRMED} The rig says: {evidence.detail}"

    return lambda: asyncio.run(stop())


def at_service(url: str, token: str, stray: Callable[[], bool] = lambda: True) -> Callable[[], str]:
    """Return what stops the rig of a service elsewhere; `stray` as in `at_rig`."""

    def stop() -> str:
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}) as client:
            # An error of this query must not prevent a stop, nor a state that the service has not heard of lately.
            with contextlib.suppress(Exception):
                rig = client.get("/v1/rig", timeout=STATUS_S).raise_for_status().json() if stray() else {}
                if rig["state"] in IDLE and rig["connected"] and rig["age_s"] < HEARD_S and rig["holder"] is None:
                    return NOTHING
            try:
                answer = client.post("/v1/stop", json={"reason": REASON}, timeout=STOP_S + 1.0)
            except httpx.HTTPError as error:
                return f"{NOT_CONFIRMED} {url}: {error}"
        return CONFIRMED if answer.is_success else f"{NOT_CONFIRMED} {url}: {answer.text[:300]}"

    return stop

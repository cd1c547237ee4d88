"""Evidence of a stop: the state that the device reports, and the fall of the torque."""

from __future__ import annotations

import math

from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.errors import DeviceError
from stimrig.rig.gate import Gate
from stimrig.rig.tasks import Tasks

DECAY_S = 3.0
"""Rig seconds within which the torque must fall to half; the slowest muscle of the paper takes about 1 s."""
NEAR_REST_NM = 0.5
AROUND_S = 0.05
"""Real seconds over which the median of the torque is taken."""
POLL_S = 0.01
"""Real seconds between two looks at the torque. A machine that stood still between them has waited no longer."""
SILENT_S = 0.4
"""Real seconds without any sample after which none is waited for. While a backlog is read the wait is longer: only
torque after it counts."""
LONGEST_S = 5.0
"""Rig seconds after which no torque is waited for, whatever the machine did meanwhile."""
NO_SIGNAL = "there is no torque signal to confirm the stop"
ATTEMPTS = 2


async def stop_device(gate: Gate) -> tuple[bool, str | None, str]:
    """Stop and ask: (whether the device reports that it cannot stimulate, its state, what went wrong). Never raises."""
    error_text = ""
    for _ in range(ATTEMPTS):  # the first answer may have been damaged on the line
        try:
            await gate.stop()
            safe, state = await gate.state()
        except DeviceError as error:
            error_text = str(error)
            continue
        return safe, state, ""
    return False, None, "; ".join(part for part in (error_text, gate.still_possible()) if part)


async def watch_decay(
    gate: Gate, receiver: Receiver, tasks: Tasks, rest_nm: float | None, at_stop_nm: float | None
) -> tuple[bool, str]:
    """Wait until the torque has fallen to half or close to rest, or until the time for that is over.

    `rest_nm`, `at_stop_nm`: torque right before the first pulse and at the stop, N·m; None if unknown.
    """
    if gate.last_pulse_s is None:
        return True, "no pulse had been sent"
    if rest_nm is None:
        return False, NO_SIGNAL
    if at_stop_nm is not None and not math.isfinite(at_stop_nm):
        at_stop_nm = None
    above_nm = 0.0 if at_stop_nm is None else at_stop_nm - rest_nm  # if unknown, the torque must come close to rest
    clock = tasks.clock
    waited_s = quiet_s = 0.0
    began_s = looked_s = clock.now_s()
    while True:
        # torque from a backlog is old, perhaps from the rest before the test: it does not count
        now_nm = receiver.torque_around(AROUND_S * clock.speed) if receiver.settled() else None
        if now_nm is not None and abs(now_nm - rest_nm) <= max(NEAR_REST_NM, 0.5 * abs(above_nm)):
            return True, _near_rest(at_stop_nm, abs(above_nm), now_nm)
        since_s = looked_s - began_s
        if now_nm is not None and since_s >= DECAY_S:
            return False, f"torque is still {now_nm:.2f} N·m {since_s:.0f} s after the stop"
        if waited_s >= max(DECAY_S, SILENT_S * clock.speed) or quiet_s >= SILENT_S * clock.speed or since_s > LONGEST_S:
            return False, NO_SIGNAL
        await tasks.sleep(POLL_S)
        now_s = clock.now_s()
        step_s = min(now_s - looked_s, POLL_S * clock.speed)
        waited_s += step_s
        quiet_s = 0.0 if receiver.age_s(now_s) <= now_s - looked_s else quiet_s + step_s
        looked_s = now_s


def _near_rest(at_stop_nm: float | None, above_nm: float, now_nm: float) -> str:
    if at_stop_nm is None:
        return f"torque is near rest, {now_nm:.2f} N·m; its value at the stop is unknown"
    if above_nm <= NEAR_REST_NM:
        return f"torque was near rest and still is, {now_nm:.2f} N·m: too small to show a fall"
    return f"torque fell from {at_stop_nm:.2f} to {now_nm:.2f} N·m"

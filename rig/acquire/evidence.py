"""A stop is confirmed by its effect: what the device says of itself, and the torque falling."""

from __future__ import annotations

from rig.acquire.receiver import Receiver
from rig.clock import Clock
from rig.errors import DeviceError
from rig.gate import Gate
from rig.messages import StopEvidence

DECAY_S = 3.0
"""Rig seconds in which the torque must have halved; the slowest muscle of the paper takes about 1 s."""
NEAR_REST_NM = 0.5
AROUND_S = 0.05
"""Real seconds over which a torque's median is taken."""
SILENT_S = 0.4
"""Real seconds to wait for a torque at all. While a backlog is read the wait goes on: what comes after it counts."""
ATTEMPTS = 2


def stop_device(gate: Gate) -> tuple[bool, str | None, str]:
    """Stop and ask: (the device says that it cannot stimulate, its state, what went wrong). Never raises."""
    said = ""
    for _ in range(ATTEMPTS):  # the first answer may have been damaged on its way
        try:
            gate.stop()
            safe, state = gate.state()
        except DeviceError as error:
            said = str(error)
            continue
        return safe, state, ""
    return False, None, "; ".join(part for part in (said, gate.still_possible()) if part)


def watch_decay(
    gate: Gate, receiver: Receiver, clock: Clock, rest_nm: float | None, at_stop_nm: float | None
) -> tuple[bool, str]:
    """Wait until the torque has fallen to half, or close to where it rested, or has clearly not.

    Parameters
    ----------
    rest_nm, at_stop_nm
        Torque right before the first pulse and at the stop, N·m; None where there was none.
    """
    if gate.last_pulse_s is None:
        return True, "no pulse had been sent"
    if rest_nm is None:
        return False, "no torque to confirm the stop by"
    above_nm = 0.0 if at_stop_nm is None else at_stop_nm - rest_nm  # unknown: then it must come close to its rest
    deadline_s, silent_s = clock.now_s() + DECAY_S, clock.now_s() + SILENT_S * clock.speed
    while True:
        # what a buffer gives up is old, the rest before the test at worst: it says nothing of now
        now_nm = receiver.torque_around(AROUND_S * clock.speed) if receiver.settled() else None
        if now_nm is None:
            reading = receiver.age_s(clock.now_s()) <= AROUND_S * clock.speed
            if clock.now_s() >= (deadline_s if reading else silent_s):
                return False, "no torque to confirm the stop by"
            clock.wait(clock.now_s() + 0.01 * clock.speed)
            continue
        if abs(now_nm - rest_nm) <= max(NEAR_REST_NM, 0.5 * abs(above_nm)):
            return True, _near_rest(at_stop_nm, abs(above_nm), now_nm)
        if clock.now_s() >= deadline_s:
            return False, f"torque is still {now_nm:.2f} N·m {DECAY_S:g} s after the stop"
        clock.wait(clock.now_s() + 0.01 * clock.speed)


def _near_rest(at_stop_nm: float | None, above_nm: float, now_nm: float) -> str:
    """What the torque says, and no more than that."""
    if at_stop_nm is None:
        return f"torque is near its rest, {now_nm:.2f} N·m; what it was at the stop is not known"
    if above_nm <= NEAR_REST_NM:
        return f"torque was near its rest and is, {now_nm:.2f} N·m: too small to tell more"
    return f"torque fell from {at_stop_nm:.2f} to {now_nm:.2f} N·m"


def evidence(
    device: tuple[bool, str | None, str],
    torque: tuple[bool, str],
    last_pulse_age_s: float | None,
    pulse_may_follow: bool,
) -> StopEvidence:
    """Both findings in one answer."""
    safe, state, said = device
    falling, words = torque
    return StopEvidence(
        confirmed=safe and falling,
        detail="; ".join(part for part in (f"device: {state or 'did not answer'}", said, words) if part),
        last_pulse_age_s=last_pulse_age_s,
        pulse_may_follow=pulse_may_follow,
        device_state=state,
    )

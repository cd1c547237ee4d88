"""The faults of the campaign: what each is, what it must lead to, and when the host can know of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

Must = Literal["stop", "go on", "either"]

WATCH_S = 0.1
"""The rig's watch for torque, angle and acks (defaults)."""
STILL_S = 0.5
"""Real seconds for which the angle of a moving test may stand still."""
SYNC_WATCH_S = 3.5
"""The rig's watch for the disk, and the time from one attempt to the next."""
PAGE_S = 0.08
"""How long the journal still finds room when no page is free: in its last one, 4 kB, at 33 bytes a sample."""
WINDOW_S = 1.0
"""Rig seconds of a phase within which a fault comes."""
PHASES = ("arming", "prbs", "rest", "ramp", "sealing")


@dataclass(frozen=True)
class Case:
    """One fault.

    Attributes
    ----------
    must
        What it must lead to when it comes while pulses are due: stop the test, let it go on, or either by chance.
    hidden_s
        Real seconds from the injection to the moment at which the host can know: nothing was heard for as long as
        the rig waits. The 50 ms count from there.
    of
        Where it happens.
    resting
        What it must lead to in a rest, where no pulse is sent that could fail.
    fault
        The emulator's name of it, where that is another.
    may_follow
        How many pulses may be felt long after: what the line itself held back.
    """

    name: str
    must: Must
    hidden_s: float = 0.0
    of: Literal["emulator", "host"] = "emulator"
    settings: dict[str, Any] = field(default_factory=dict)
    resting: Must | None = None
    loses_samples: bool = False
    fault: str = ""
    may_follow: int = 0

    @property
    def of_the_angle(self) -> bool:
        """Whether it breaks the angle sensor: then a robot moves the arm, and the test asks for the angle."""
        return self.name.startswith("angle_")

    def command(self, speed: float) -> dict[str, Any]:
        """For the emulator's control line; delays in emulated seconds: a rig that runs faster waits for real ones."""
        settings = {key: value * speed if key.endswith("_s") else value for key, value in self.settings.items()}
        return {"cmd": "fault", "name": self.fault or self.name, "on": True, **settings}


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("stimulator_unplugged", "stop"),
        Case("no_ack", "stop", WATCH_S),
        Case("late_ack", "stop", WATCH_S, settings={"delay_s": 0.2}),
        Case("line_stalled", "stop", WATCH_S, may_follow=1),
        Case("line_stalled_70_ms", "go on", fault="line_stalled", settings={"for_s": 0.07}),
        Case("corrupt_answers", "stop", WATCH_S),
        Case("corrupt_commands", "stop", WATCH_S),
        Case("electrode_error", "stop", resting="either"),
        Case("high_voltage_error", "stop", resting="either"),
        Case("emergency_switch", "stop", resting="either"),
        Case("device_reset", "stop", settings={"mid_frame": True}, resting="either"),
        Case("cell_silent", "stop", WATCH_S),
        Case("cell_unplugged", "stop", WATCH_S),
        Case("bus_off", "stop", WATCH_S),
        Case("torque_nan", "stop"),
        Case("torque_step", "stop"),
        Case("torque_stuck", "stop", 0.5),
        Case("counter_jump", "stop", settings={"step": 9000}),
        Case("torque_sign_flipped", "either", 1.0),
        Case("torque_saturated", "either", 1.5),
        Case("frames_corrupt", "either", 1.0, loses_samples=True),
        Case("rate_off", "either", 4.0, settings={"percent": 5.0}),
        Case("frames_dropped", "go on", loses_samples=True),
        Case("frames_duplicated", "go on"),
        Case("frames_out_of_order", "go on", loses_samples=True),
        Case("error_frames", "go on"),
        Case("clock_jitter", "go on"),
        Case("delivery_jitter", "go on"),
        Case("angle_silent", "stop", WATCH_S),
        Case("angle_unplugged", "stop", WATCH_S),
        Case("angle_nan", "stop"),
        Case("angle_fault_bit", "stop"),
        Case("angle_jump", "stop", settings={"probability": 1.0}),
        Case("angle_offset_step", "stop"),
        Case("angle_counter_jump", "stop"),
        Case("angle_stuck", "stop", STILL_S),
        Case("angle_rate_off", "either", 4.0),
        Case("angle_noise_burst", "either", 1.0),
        Case("angle_reversed", "either", 1.0),
        Case("angle_delayed", "go on"),
        Case("angle_frames_lost", "go on"),
        Case("angle_frames_repeated", "go on"),
        Case("disk_full", "stop", PAGE_S, of="host"),
        Case("disk_slow", "stop", SYNC_WATCH_S, of="host"),
        Case("host_killed", "stop", of="host"),
        Case("host_stopped_2s", "stop", of="host"),
        Case("wall_clock_an_hour_on", "go on", of="host"),
        Case("machine_under_load", "either", 5.0, of="host"),
    )
}


def plan_of(phase: str, hidden_s: float, speed: float) -> list[dict[str, Any]]:
    """Segments of a test in which that phase comes soon and lasts until the fault must have been seen.

    Parameters
    ----------
    hidden_s
        Real seconds until it can be seen.
    speed
        Rig seconds a real second.
    """
    lasting_s = WINDOW_S + (hidden_s + 1.0) * speed
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.6}}
    chip = max(1, math.ceil(lasting_s / (127 * 0.025)))
    prbs = {"name": "prbs", "sequence": "prbs", "settings": {"bits": 7, "clock_pulses": chip}}
    ramp_s = max(1.6, round(lasting_s / 2, 1))
    ramp = {"name": "ramp", "sequence": "ramp", "settings": {"up_s": ramp_s, "down_s": ramp_s}}
    first = {"name": "steps", "sequence": "steps", "settings": {"on_s": 0.5, "off_s": 0.0, "repeats": 1}}
    pause = {"name": "rest", "sequence": "rest", "settings": {"duration_s": max(2.0, round(lasting_s, 1))}}
    return {
        "arming": [rest, prbs],
        "prbs": [rest, prbs],
        "rest": [rest, first, pause, first],
        "ramp": [rest, ramp],
        "sealing": [rest, first],
    }[phase]


def angle_of(case: Case, speed: float) -> dict[str, Any]:
    """What the plan of a test asks of the angle, for the faults of its sensor."""
    if not case.of_the_angle:
        return {}
    return {"kind": "moving", "angle": {"range_rad": [0.3, 2.3], "still_s": STILL_S * speed}}


def movement_of(case: Case) -> dict[str, Any]:
    """Who moves the arm in a test, for the emulator's control line: a robot, or nobody."""
    if not case.of_the_angle:
        return {"cmd": "arm", "mode": "held", "angle_deg": 60.0}
    return {"cmd": "arm", "mode": "robot", "from_deg": 40.0, "to_deg": 90.0, "deg_s": 30.0}

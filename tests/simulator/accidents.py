"""What can befall a rig: each accident is a function of a life and its own source of chance, found by its name here."""

from __future__ import annotations

import random
from collections.abc import Callable
from inspect import isfunction
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.simulator.life import Life

Accident = Callable[["Life", random.Random], str]
"""Makes it happen now; what happened, in words, for the trace."""

OF_DEVICES = (
    "no_ack", "late_ack", "electrode_error", "emergency_switch", "high_voltage_error", "device_reset",
    "stimulator_unplugged", "cell_silent", "cell_unplugged", "frames_dropped", "frames_duplicated",
    "frames_out_of_order", "frames_corrupt", "torque_stuck", "torque_nan", "torque_sign_flipped", "torque_saturated",
    "torque_step", "bus_off", "error_frames", "counter_jump", "rate_off", "clock_jitter", "delivery_jitter",
)  # fmt: skip
"""Faults of the emulator's own library (hardware_sim/faults)."""
OF_THE_ANGLE = (
    "angle_stuck", "angle_silent", "angle_unplugged", "angle_jump", "angle_nan", "angle_offset_step", "angle_reversed",
    "angle_noise_burst", "angle_delayed", "angle_fault_bit", "angle_frames_lost", "angle_frames_repeated",
    "angle_counter_jump", "angle_rate_off",
)  # fmt: skip


def device_fault(life: Life, chance: random.Random) -> str:
    """A fault of a device or its cable."""
    names = OF_DEVICES + OF_THE_ANGLE if life.arm else OF_DEVICES
    name, for_s = chance.choice(names), chance.uniform(0.02, 1.5)
    life.devices.faults.on(name, {}, for_s)
    life.wires.pump()
    return f"{name} for {for_s:.3f} s"


def line_stalls(life: Life, chance: random.Random) -> str:
    """The serial line holds what is sent, in one direction or both, and lets it go at once."""
    for_s, discards = (
        chance.choice((0.005, 0.02, 0.08, 0.3, 1.0, 2.0)) * chance.uniform(0.5, 1.5),
        chance.random() < 0.5,
    )
    ways = chance.choice(((life.wires.to_device,), (life.wires.to_host,), (life.wires.to_device, life.wires.to_host)))
    for way in ways:
        way.stall(for_s, discards)
    return f"{' '.join(way.name for way in ways)} for {for_s:.3f} s, {'here' if discards else 'beyond this computer'}"


def line_deviates(life: Life, chance: random.Random) -> str:
    """Pieces of bytes are dropped, doubled, corrupted, torn or late for a while."""
    way = chance.choice((life.wires.to_device, life.wires.to_host))
    deviance, odds = chance.choice(("drop", "double", "corrupt", "reorder", "tear")), chance.choice((0.02, 0.2, 1.0))
    way.odds[deviance] = odds
    for_s = chance.uniform(0.02, 1.0)
    life.world.after(for_s, lambda: way.odds.pop(deviance, None))
    return f"{way.name} {deviance} {odds:g} for {for_s:.3f} s"


def bus_stalls(life: Life, chance: random.Random) -> str:
    """The CAN adapter holds its frames for a while."""
    for_s = chance.choice((0.03, 0.09, 0.2, 0.6)) * chance.uniform(0.5, 1.5)
    life.wires.bus_stalled_until_s = life.world.now_s + for_s
    return f"for {for_s:.3f} s"


def host_pauses(life: Life, chance: random.Random) -> str:
    """Nothing runs on the rig's computer for a while."""
    for_s = 10 ** chance.uniform(-3, 0.48)
    life.computer.pause(for_s)
    return f"for {for_s:.3f} s"


def host_is_disturbed(life: Life, chance: random.Random) -> str:
    """For a while a share of the computer's time is taken away, in pieces of 20 to 800 ms."""
    share, until_s = chance.choice((0.1, 0.3)), life.world.now_s + chance.uniform(1.0, 8.0)

    def next_piece() -> None:
        piece_s = chance.uniform(0.02, 0.8)
        if life.world.now_s < until_s and not life.quiet:
            life.computer.pause(piece_s)
            life.world.after(piece_s + chance.expovariate(share / (1 - share) / 0.41), next_piece)

    next_piece()
    return f"{share:g} of the time until {until_s:.3f} s"


def step_stalls(life: Life, chance: random.Random) -> str:
    """The computer stands still in the middle of a step: between a written intent and its command, for instance."""
    life.computer.stall_next_s = for_s = 10 ** chance.uniform(-3, 0.3)
    return f"for {for_s:.3f} s, at the next access to a port or a file"


def wall_clock_jumps(life: Life, chance: random.Random) -> str:
    """The wall clock is set."""
    by_s = chance.choice((-86_400.0, -3600.0, 5.0, 3600.0, 1e7))
    life.computer.set_wall_clock(by_s)
    return f"by {by_s:g} s"


def disk_is_full(life: Life, chance: random.Random) -> str:
    """Nothing more fits for a while; a block is cut short."""
    life.disk.free, for_s = chance.choice((0, 100, 5000, 20_000)), chance.uniform(0.2, 3.0)
    life.world.after(for_s, life.disk.heal)
    return f"for {for_s:.3f} s, {life.disk.free} bytes left"


def disk_fails(life: Life, chance: random.Random) -> str:
    """Every access gives an error for a while."""
    life.disk.failing, for_s = True, chance.uniform(0.1, 2.0)
    life.world.after(for_s, life.disk.heal)
    return f"for {for_s:.3f} s"


def disk_is_slow(life: Life, chance: random.Random) -> str:
    """Each piece of work takes long."""
    life.disk.slow_s, for_s = chance.choice((0.05, 0.3, 4.0)), chance.uniform(0.2, 4.0)
    life.world.after(for_s, life.disk.heal)
    return f"{life.disk.slow_s:g} s a piece, for {for_s:.3f} s"


def rig_is_killed(life: Life, chance: random.Random) -> str:
    """The rig's process dies at once, and is started again."""
    after_s = chance.uniform(0.05, 1.0)
    life.kill(after_s)
    return f"started again after {after_s:.3f} s"


def rig_dies_in_a_step(life: Life, _chance: random.Random) -> str:
    """The rig's process dies between two lines of its program: after an intent and before its command, for instance."""
    life.computer.dies_next = True
    return "at the next access to a port or a file"


def rig_dies_after_a_stop(life: Life, chance: random.Random) -> str:
    """The rig's process dies shortly after it has answered the next stop."""
    life.clinic.dies_after_stop_s = for_s = chance.uniform(0.0, 0.05)
    return f"{1e3 * for_s:.1f} ms after the next one"


def power_fails(life: Life, chance: random.Random) -> str:
    """The rig's computer loses its power, and what was not synced."""
    after_s = chance.uniform(0.5, 2.0)
    life.power_failure(after_s)
    return f"on again after {after_s:.3f} s"


def rig_is_ended(life: Life, _chance: random.Random) -> str:
    """SIGTERM."""
    life.end_process()
    return "and started again"


def devices_lose_power(life: Life, _chance: random.Random) -> str:
    """All devices start anew."""
    life.devices.power_cycle()
    life.wires.pump()
    return ""


def requests_are_lost(life: Life, chance: random.Random) -> str:
    """The service and the rig do not hear each other for a while."""
    life.clinic.loses, for_s = chance.choice((0.3, 1.0)), chance.uniform(0.1, 2.0)
    life.world.after(for_s, life.heal_requests)
    return f"{life.clinic.loses:g} for {for_s:.3f} s"


LIBRARY: dict[str, Accident] = {
    name: found
    for name, found in [*globals().items()]
    if isfunction(found) and found.__module__ == __name__ and not name.startswith("_")
}
ODDS = {
    "device_fault": 6.0, "line_stalls": 3.0, "line_deviates": 3.0, "host_pauses": 3.0, "host_is_disturbed": 3.0,
    "step_stalls": 2.0,
}  # fmt: skip
"""How often, beside 1 for the others."""

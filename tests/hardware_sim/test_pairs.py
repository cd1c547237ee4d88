"""Each stimulator, cell and transport: it starts, plays, and the bus shows what the muscle did."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import can
import numpy as np
import pytest
import serial

from bench.muscles.offline import simulate
from stimrig.hardware_sim import load_cells, patients
from stimrig.hardware_sim.stimulators import STIMULATORS
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2, ScienceMode4
from tests.hardware_sim.bench_board import LL_CONFIG, LL_INIT, biphasic, config
from tests.hardware_sim.emulated import emulated

pytestmark = pytest.mark.wire
PULSES = 12
PERIOD_S = 0.025
ENOUGH_NM = 1.0
Play = Callable[[serial.Serial], None]


def paced(line: serial.Serial, frames: list[bytes], ack_bytes: int) -> None:
    """Never in a burst, however busy the machine: a RehaStim 2 refuses a pulse during another."""
    for frame in frames:
        line.write(frame)
        assert len(line.read(ack_bytes)) == ack_bytes
        time.sleep(PERIOD_S)


def p24(line: serial.Serial) -> None:
    line.write(ScienceMode4.encode(Packet(1, LL_INIT, b"\x00")))
    assert line.read(13)[-2:] == b"\x00\x0f"
    frames = [ScienceMode4.encode(Packet(k, LL_CONFIG, config(*biphasic(300, 20)))) for k in range(PULSES)]
    paced(line, frames, 15)


def rehastim2(line: serial.Serial) -> None:
    line.reset_input_buffer()
    (init,) = ScienceMode2().feed(line.read(10), 0.0)
    line.write(ScienceMode2.encode(Packet(init.number, 2, b"\x00")))
    pulse = bytes.fromhex("00012c14")
    frames = [ScienceMode2.encode(Packet(k, 36, pulse)) for k in range(PULSES)]
    paced(line, frames, 9)


class Cell(NamedTuple):
    """How to ask for a cell, and how its frames read: the values' places and the counter's."""

    options: str
    can_id: int
    layout: str
    values: int = 1
    counter: int | None = 1
    scale: float = 1.0
    zero: int = 0

    def decode(self, data: bytes) -> tuple[list[float], int | None]:
        """Torques, N·m, and the counter of a frame."""
        row = struct.unpack(self.layout, data)
        counter = None if self.counter is None else row[self.counter]
        return [self.scale * (value - self.zero) for value in row[: self.values]], counter


PLAYERS: dict[str, tuple[int, str, Play]] = {"p24": (3_000_000, "N", p24), "rehastim2": (460_800, "E", rehastim2)}
CELLS = {
    "plain": Cell("--cell plain", 0x181, "<fHBB"),
    "plain of 3": Cell("--cell plain --samples-per-frame 3", 0x181, "<hhhH", values=3, counter=3, scale=0.002),
    "counts": Cell("--cell counts", 610, ">H", counter=None, scale=50 / 32767, zero=32768),
    "canopen": Cell("--cell canopen", 0x181, "<fHBB"),
    "with_angle": Cell("--arm held --arm-law passive=none --angle in-cell", 0x181, "<fhBB", counter=2),
}


def test_every_kind_there_is_is_paired() -> None:
    assert all(set(names) <= {*sum(PAIRS, ())} for names in (PLAYERS, CELLS))
    assert set(PLAYERS) == set(STIMULATORS)
    assert {name.split()[0] for name in CELLS} == set(load_cells.CELLS)
    assert set(load_cells.TRANSPORTS) == {"socketcand", "slcan"}


PAIRS = [
    ("p24", "plain", "socketcand"),
    ("rehastim2", "plain of 3", "slcan"),
    ("p24", "counts", "slcan"),
    ("rehastim2", "canopen", "socketcand"),
    ("p24", "with_angle", "socketcand"),
]
"""Each device and each transport, in several; a campaign of `tests/wire/test_pairs.py` plays all pairs."""


@pytest.mark.parametrize(("stimulator", "cell", "transport"), PAIRS)
def test_it_starts_and_plays(stimulator: str, cell: str, transport: str) -> None:
    baud, parity, play = PLAYERS[stimulator]
    made = CELLS[cell]
    devices = ["--load-cell", transport, "--stimulator", stimulator]
    with (
        emulated("--rate-hz", "400", "--noise-nm", "0", *devices, *made.options.split()) as rig,
        can.Bus(**rig.ready["can"]) as bus,
    ):
        if cell == "canopen":
            bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
        first = bus.recv(10.0)
        assert first is not None
        with serial.Serial(rig.ready["stimulator"], baud, parity=parity, timeout=20) as line:
            play(line)
            end_s = time.monotonic() + 20
            messages = [first]
            while made.decode(bytes(messages[-1].data))[0][-1] <= ENOUGH_NM and time.monotonic() < end_s:
                messages += [message for message in [bus.recv(0.1)] if message is not None]
        pulses = rig.ask(cmd="pulses")["pulses"]
        state = rig.ask(cmd="state")
        assert rig.ready["stimulator_device"] == stimulator
        assert rig.ready["samples_per_frame"] == made.values
        angle = ("in_cell", 0x181, 400.0) if cell == "with_angle" else None
        told = rig.ready.get("angle_sensor")
        assert angle == (told and (told["kind"], told["frame_id"], told["rate_hz"]))
    assert [(pulse["width_us"], pulse["current_ma"], pulse["delivered"]) for pulse in pulses] == [(300, 20, True)] * 12
    assert state["unbalanced_pulses"] == 0

    assert {(message.arbitration_id, message.is_extended_id) for message in messages} == {(made.can_id, False)}
    decoded = [made.decode(bytes(message.data)) for message in messages]
    values = np.array([value for torques, _ in decoded for value in torques])
    assert values.size == made.values * len(messages)
    counters = [counter for _, counter in decoded if counter is not None]
    wraps_at = 0x100 if cell == "with_angle" else 0x10000
    assert {(after - before) % wraps_at for before, after in pairwise(counters)} <= {1}
    assert bool(counters) is rig.ready["has_counter"]

    times_s, duration_s = [pulse["time_s"] for pulse in pulses], state["time_s"] + 0.01
    torque_nm = simulate(patients.make("paper"), times_s, [300.0] * 12, 20.0, 400.0, duration_s)
    # without a counter, and over NMT, the first sample's number is known only from its value's later rise
    offsets = range(torque_nm.size - values.size)
    errors_nm = [np.abs(torque_nm[k : k + values.size] - values).max() for k in offsets]
    assert min(errors_nm) < 2e-3  # one count of the coarsest cell
    assert values.max() > ENOUGH_NM
    if counters and made.values == 1:
        assert int(np.argmin(errors_nm)) % wraps_at == pytest.approx(counters[0], abs=1)

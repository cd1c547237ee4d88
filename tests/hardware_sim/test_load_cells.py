"""Samples, frames and both transports; python-can is the oracle on the wire."""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import struct
import time
from typing import Any

import can
import numpy as np
import pytest
import serial

from stimrig.hardware_sim.load_cells.cells import CanOpen, Counts, Plain
from stimrig.hardware_sim.load_cells.frames import Frame, Sample
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from stimrig.hardware_sim.load_cells.slcan import Slcan
from stimrig.hardware_sim.load_cells.socketcand import QUIET_S, Socketcand
from stimrig.hardware_sim.ports import PseudoTerminal, Reactor
from stimrig.hardware_sim.settings import Settings
from tests.hardware_sim.emulated import emulated

LAYOUT, PACKED = struct.Struct("<fHBB"), struct.Struct("<hhhH")
PERIOD_S = 1 / 1600.0


class Ramp:
    """Torque equals time."""

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        raise AssertionError((time_s, width_us, current_ma))

    def torque_nm(self, time_s: float) -> float:
        return time_s


def cell(noise_nm: float = 0.0, **settings: Any) -> LoadCell:
    return LoadCell(Ramp(), Settings(noise_nm=noise_nm, **settings))


def decoded(frames: list[Frame]) -> list[tuple[float, int, int]]:
    return [LAYOUT.unpack(frame.data)[:3] for frame in frames]


class TestSampler:
    def test_times_are_exact_multiples_of_the_period_however_it_is_called(self) -> None:
        made = cell()
        for until_s in np.cumsum(np.random.default_rng(0).uniform(0, 0.01, 300)):
            made.produce(until_s)
        frames = made.take_frames()
        assert [f.time_us for f in frames] == [625 * n for n in range(len(frames))]
        assert [torque for torque, *_ in decoded(frames)] == [np.float32(n / 1600) for n in range(len(frames))]

    @pytest.mark.parametrize(("pulse_s", "first"), [(0.0, 0), (1.2 / 1600, 2), (2 / 1600, 2), (2.01 / 1600, 3)])
    def test_sync_is_in_the_first_sample_at_or_after_the_pulse(self, pulse_s: float, first: int) -> None:
        made = cell()
        made.produce(pulse_s)
        made.raise_sync()
        made.produce(6 / 1600)
        assert [n for n, (_, _, status) in enumerate(decoded(made.take_frames())) if status & 1] == [first]

    def test_no_sync_line(self) -> None:
        made = cell(sync=False)
        made.raise_sync()
        made.produce(0.01)
        assert not any(status for _, _, status in decoded(made.take_frames()))

    def test_drift_offset_and_noise(self) -> None:
        made = cell(noise_nm=0.1, noise_seed=5, torque_offset_nm=2.0, clock_ppm=200.0)
        made.produce(10.0)
        frames = made.take_frames()
        assert len(frames) == pytest.approx(16003, abs=1)
        assert frames[1600].time_us == pytest.approx(1_000_000, abs=1)  # its own clock does not know
        noise = np.array([t for t, *_ in decoded(frames)]) - np.arange(len(frames)) / 1600.32 - 2.0
        assert noise.mean() == pytest.approx(0.0, abs=0.004)
        assert noise.std() == pytest.approx(0.1, rel=0.03)
        assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.03


class TestCells:
    def test_counts_have_stops(self) -> None:
        frames = [Counts().encode([Sample(t, 0, True, 0)]) for t in (0.0, 50.0, -60.0, 60.0, math.nan)]
        assert [int.from_bytes(f.data, "big") for f in frames] == [32768, 65535, 0, 65535, 0]

    def test_canopen_sends_between_start_and_stop(self) -> None:
        made = CanOpen()
        assert not made.running
        for message in (b"\x01\x02", b"\x01\x01", b"\x80\x00", b"\x01\x00", b"\x02\x00"):
            made.received(0, message)
            assert made.running is (message in (b"\x01\x01", b"\x01\x00"))


def recorded(made: LoadCell, until_s: float) -> tuple[np.ndarray, np.ndarray]:
    """True times (the muscle's torque is the time) and stamps, s."""
    made.produce(until_s)
    frames = made.take_frames()
    times_s = [struct.unpack("<fHBB", frame.data)[0] for frame in frames]
    return np.array(times_s), np.array([1e-6 * frame.time_us for frame in frames])


def test_jitter_moves_each_sample_and_none_overtakes() -> None:
    times_s, stamps_s = recorded(cell(clock_jitter_us=100.0), 4.0)
    off_s = times_s - PERIOD_S * np.arange(times_s.size)
    assert off_s.std() == pytest.approx(100e-6, rel=0.05)
    assert abs(off_s.mean()) < 5e-6
    assert np.allclose(stamps_s, times_s, atol=2e-6)
    assert abs(np.corrcoef(off_s[1:], off_s[:-1])[0, 1]) < 0.05
    wild_s, _ = recorded(cell(clock_jitter_us=10_000.0), 4.0)
    assert np.diff(wild_s).min() > 0.05 * PERIOD_S
    assert wild_s.size == pytest.approx(6400, abs=1)


def test_jitter_can_be_switched_and_leaves_the_grid_where_it_was() -> None:
    made = cell()
    recorded(made, 1.0)
    made.clock.set_jitter(100e-6)
    made.clock.set_rate_factor(1.0)  # a new anchor takes no jitter over
    recorded(made, 2.0)
    made.clock.set_jitter(0.0)
    recorded(made, 2.01)
    times_s, _ = recorded(made, 3.0)
    off_s = (times_s + PERIOD_S / 2) % PERIOD_S - PERIOD_S / 2
    assert np.abs(off_s).max() < 1e-6


@pytest.mark.parametrize("jitter_us", [0.0, 50.0])
def test_three_samples_a_frame(jitter_us: float) -> None:
    made = cell(samples_per_frame=3, clock_jitter_us=jitter_us)
    made.counter = 3 * 65534
    made.produce(2.0)
    frames = made.take_frames()
    rows = [PACKED.unpack(frame.data) for frame in frames]
    assert [row[3] for row in rows[:4]] == [65534, 65535, 0, 1]
    values = np.array([row[:3] for row in rows]).ravel() / 500
    assert values == pytest.approx(PERIOD_S * np.arange(values.size), abs=1e-3 + 3 * 50e-6)
    last_s = np.array([frame.time_us for frame in frames]) * 1e-6
    assert last_s == pytest.approx(PERIOD_S * (3 * np.arange(len(frames)) + 2), abs=1e-6 if not jitter_us else 3e-4)


def test_packed_values_have_stops_and_a_counter_jump_shows() -> None:
    def frame(*torques_nm: float, counter: int = 0) -> tuple[int, ...]:
        samples = [Sample(t, counter + k, True, 0) for k, t in enumerate(torques_nm)]
        return PACKED.unpack(Plain(3).encode(samples).data)

    assert frame(1.0, -70.0, 70.0) == (500, -32767, 32767, 0)
    assert frame(math.nan, 0.001, 0.0, counter=1003) == (-32767, 0, 0, 335)
    assert Counts(2).encode([Sample(50.0, 0, False, 1), Sample(-60.0, 1, False, 2)])[1:3] == (b"\xff\xff\0\0", 2)


def listen(bus: can.BusABC, number: int) -> list[can.Message]:
    messages = []
    for _ in range(number):
        message = bus.recv(10.0)
        assert message is not None
        messages.append(message)
    return messages


@pytest.mark.wire
def test_clients_come_and_go_and_a_deaf_one_harms_nobody() -> None:
    with emulated("--speed", "20") as rig:
        where = rig.ready["can"]
        deaf = socket.create_connection((where["host"], where["port"]))
        for expected, reply in ((b"< hi >", b"< open can0 >"), (b"< ok >", b"< rawmode >"), (b"< ok >", b"")):
            assert deaf.recv(64) == expected
            deaf.sendall(reply)
        for _ in range(2):
            with can.Bus(**where) as bus:
                listen(bus, 1600)  # one that is held up sends none
        assert rig.ask(cmd="state")["ok"]
        deaf.close()


def turn(reactor: Reactor, port: Any) -> None:
    """Turn until the port has something to read."""
    end_s = time.monotonic() + 10
    while not select.select([port], [], [], 0)[0]:
        assert time.monotonic() < end_s, "no answer"
        reactor.poll(0.01)


def test_socketcand_handshake_is_quiet_and_bad_input_is_answered() -> None:
    reactor, received = Reactor(), []
    server = Socketcand(reactor, lambda *frame: received.append(frame))
    client = socket.create_connection((server.can["host"], server.can["port"]), timeout=20)

    def ask(text: bytes) -> bytes:
        client.sendall(text)
        turn(reactor, client)
        return client.recv(256)

    assert ask(b"") == b"< hi >"
    assert ask(b"< rawmode >") == b"< error unknown command >"
    assert ask(b"< open can7 >") == b"< error could not open bus >"
    assert ask(b"< open can0 >") == b"< ok >"
    assert ask(b"< rawmode >") == b"< ok >"
    server.send([Frame(0x181, b"\x01", 1_000_001)])
    assert not select.select([client], [], [], 0.02)[0]
    time.sleep(QUIET_S)
    frames = [Frame(0x181, b"\x01\xab", 1_000_001), Frame(0x18FF0001, b"", 0), Frame(0x20000040, b"", 5, error=True)]
    server.send(frames)
    turn(reactor, client)
    assert client.recv(256) == (b"< frame 181 1.000001 01AB >< frame 18FF0001 0.000000  >< error 20000040 0.000005 >")
    assert ask(b"< send 181 2 a ff >< send 181 3 a ff >") == b"< error unknown command >"
    assert received == [(0x181, b"\x0a\xff")]
    client.close()
    server.close()


def test_slcan_commands() -> None:
    reactor, received = Reactor(), []
    adapter = Slcan(reactor, lambda *frame: received.append(frame))
    port = os.open(adapter.can["channel"], os.O_RDWR | os.O_NOCTTY)

    def ask(text: bytes) -> bytes:
        os.write(port, text)
        turn(reactor, port)
        return os.read(port, 256)

    adapter.send([Frame(0x181, b"\x01", 0)])  # closed: nothing is sent
    assert [ask(line + b"\r") for line in (b"C", b"S6", b"", b"O", b"O", b"q")] == [b"\r"] * 5 + [b"\a"]
    frames = [Frame(0x181, b"\x01\xab", 0), Frame(0x181, b"", 0, error=True), Frame(0x18FF0001, b"", 0)]
    adapter.send(frames)
    text = b""
    while text.count(b"\r") < 2:  # the kernel hands on each frame when it likes
        turn(reactor, port)
        text += os.read(port, 256)
    assert text == b"t181201AB\rT18FF00010\r"
    assert ask(b"t00020100\r") == b"z\r"
    assert ask(b"t0003010\r") == b"\a"
    assert received == [(0, b"\x01\x00")]
    os.close(port)
    adapter.close()


def test_a_pseudo_terminal_that_nobody_reads_never_blocks() -> None:
    port = PseudoTerminal(fifo_bytes=10_000)
    started_s = time.monotonic()
    for n in range(20_000):
        port.write(b"%06d\n" % n)
    assert time.monotonic() - started_s < 5
    assert port.dropped_messages > 10_000
    reader = os.open(port.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    text = b""
    while len(text) // 7 + port.dropped_messages < 20_000 and time.monotonic() - started_s < 20:
        port.flush()
        with contextlib.suppress(BlockingIOError):
            text += os.read(reader, 65536)
    lines = text.splitlines()  # the kernel may take more while messages are dropped, so there may be holes
    assert len(lines) + port.dropped_messages == 20_000
    assert {len(line) for line in lines} == {6}  # whole messages, in order
    assert sorted(set(lines)) == lines
    os.close(reader)
    port.close()
    port.write(b"x")


def test_a_port_opens_with_even_parity_again_and_again() -> None:
    port = PseudoTerminal()
    for _ in range(3):
        with serial.Serial(port.path, 460_800, parity=serial.PARITY_EVEN):
            for _ in range(2):
                port.forget_speed()
    for _ in range(3):
        with serial.Serial(port.path, 460_800, parity=serial.PARITY_EVEN) as line:
            line.write(b"x")
            assert port.read() == b"x"
    port.close()
    port.forget_speed()

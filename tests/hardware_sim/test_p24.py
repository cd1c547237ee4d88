"""The P24's firmware on a virtual clock."""

from __future__ import annotations

import pytest

from stimrig.hardware_sim.stimulators.sciencemode import Packet
from tests.hardware_sim.virtual_host import (
    LL_CONFIG,
    LL_INIT,
    LL_STOP,
    ML_DATA,
    ML_INIT,
    ML_STOP,
    ML_UPDATE,
    VirtualHost,
    biphasic,
    config,
    points,
)

OK, PARAMETER, NOT_INITIALISED, HIGH_VOLTAGE, ELECTRODE = 0, 2, 7, 8, 10
STATUS = 62


@pytest.fixture
def bench() -> VirtualHost:
    return VirtualHost(rate_hz=10.0)


@pytest.fixture
def ready(bench: VirtualHost) -> VirtualHost:
    assert bench.ask(LL_INIT, b"\x00").data == bytes((OK,))
    return bench


def update(*shape: tuple[int, float], period_ms: float = 25, ramp: int = 0, mask: int = 1) -> bytes:
    head = bytes((len(shape) - 1 << 4 | ramp,)) + (round(2 * period_ms) << 1).to_bytes(2, "big")
    return bytes((mask,)) + (head + points(*shape)) * mask.bit_count()


def test_init_takes_40_ms_and_turns_the_source_on(bench: VirtualHost) -> None:
    bench.send(LL_INIT, b"\x00", number=4)
    bench.run(0.039)
    assert bench.sent == []
    bench.run(0.002)
    assert bench.sent == [(pytest.approx(0.040), Packet(4, 1, b"\x00"))]
    assert bench.ask(STATUS).data == bytes((OK, 1, 6))


def test_a_pulse_reaches_the_muscle_at_receipt_and_is_acked_when_it_has_ended(ready: VirtualHost) -> None:
    now_s = ready.timeline.now_s
    ack = ready.ask(LL_CONFIG, config(*biphasic(250, 20.5)), number=33)
    assert ack == Packet(33, 3, bytes((OK, 0, 0)))
    assert ready.pulses == [(now_s, 250.0, 20.5)]
    assert ready.sent[-1][0] == pytest.approx(now_s + 600e-6)
    assert ready.electrodes.unbalanced_pulses == 0


@pytest.mark.parametrize(
    "shape",
    [[(250, 20.0)], [(250, 20.0), (100, 0.0), (249, -20.0)], [(250, 20.0), (100, 0.0), (250, -19.5)], [(250, -20.0)]],
)
def test_an_unbalanced_shape_is_counted(ready: VirtualHost, shape: list[tuple[int, float]]) -> None:
    ready.ask(LL_CONFIG, config(*shape))
    assert ready.electrodes.unbalanced_pulses == 1
    assert ready.pulses[0][1:] == (250.0, 20.0)


def test_not_initialised_before_init_and_after_stop(bench: VirtualHost) -> None:
    assert bench.ask(LL_CONFIG, config(*biphasic(250, 20))).data[0] == NOT_INITIALISED
    assert bench.ask(LL_STOP).data == bytes((NOT_INITIALISED,))
    bench.ask(LL_INIT, b"\x00")
    assert bench.ask(LL_STOP).data == bytes((OK,))
    assert bench.ask(LL_CONFIG, config(*biphasic(250, 20))).data[0] == NOT_INITIALISED
    assert bench.ask(STATUS).data == bytes((OK, 0, 0))
    assert bench.pulses == []


def test_a_pulse_behind_a_stop_is_not_fired(ready: VirtualHost) -> None:
    ready.send(LL_STOP, number=1)
    ready.send(LL_CONFIG, config(*biphasic(250, 20)), number=2)
    ready.run(0.1)
    assert [(p.number, p.data[0]) for _, p in ready.sent[-2:]] == [(1, OK), (2, NOT_INITIALISED)]
    assert ready.pulses == []


@pytest.mark.parametrize(
    ("data", "result"),
    [
        (b"", PARAMETER),
        (config(*biphasic(250, 130.5)), PARAMETER),
        (config(*biphasic(0, 20), (0, 0.0))[:1] + points(*biphasic(250, 20))[:-1], PARAMETER),
        (config(*biphasic(250, 20)) + b"\x00", PARAMETER),
        (config((0, 20.0)), PARAMETER),
        (config(*biphasic(250, 20), execute=False), OK),
    ],
)
def test_bad_parameters_and_a_config_without_execute_fire_nothing(ready: VirtualHost, data: bytes, result: int):
    assert ready.ask(LL_CONFIG, data).data[0] == result
    assert (ready.pulses, ready.electrodes.log) == ([], [])


def test_limits_are_inclusive(ready: VirtualHost) -> None:
    assert ready.ask(LL_CONFIG, config(*biphasic(4095, 130))).data[0] == OK
    assert ready.pulses[0][1:] == (4095.0, 130.0)


def test_an_open_electrode_is_seen_from_15_ma_and_nothing_flows(ready: VirtualHost) -> None:
    ready.electrodes.attached = False
    assert ready.ask(LL_CONFIG, config(*biphasic(250, 15))).data[0] == ELECTRODE
    assert ready.ask(LL_CONFIG, config(*biphasic(250, 14.5))).data[0] == OK
    assert (ready.pulses, len(ready.electrodes.log)) == ([], 2)


def test_the_muscle_hangs_on_one_output(ready: VirtualHost) -> None:
    assert ready.ask(LL_CONFIG, config(*biphasic(250, 20), channel=2, connector=1)).data == bytes((ELECTRODE, 0x12, 0))
    assert [pulse.output for pulse in ready.electrodes.log] == [(1, 2)]


def test_high_voltage_that_breaks(bench: VirtualHost) -> None:
    assert bench.ask(LL_INIT, b"\x00").data[0] == OK
    bench.board.high_voltage_works = False
    assert bench.ask(STATUS).data == bytes((OK, 1, 0))
    assert bench.ask(LL_CONFIG, config(*biphasic(250, 20))).data[0] == HIGH_VOLTAGE
    for command in (LL_INIT, ML_INIT):
        assert bench.ask(command, b"\x00").data[0] == HIGH_VOLTAGE
    assert bench.pulses == []


@pytest.mark.parametrize("data", [b"", b"\x00\x00", b"\x80", b"\x01", b"\x0e", b"\x40"])
@pytest.mark.parametrize("command", [LL_INIT, ML_INIT])
def test_init_refuses_what_it_does_not_know(bench: VirtualHost, command: int, data: bytes) -> None:
    assert bench.ask(command, data).data == bytes((PARAMETER,))


def test_unknown_command_and_corrupt_frame(bench: VirtualHost) -> None:
    assert bench.ask(999, number=5) == Packet(5, 67, b"\x0b")
    bench.receive(bytes.fromhex("f081558158811681371000000f"))  # one bit of the CRC differs
    assert bench.sent[-1][1] == Packet(0, 66, b"\x01")
    assert bench.firmware.state()["corrupt_frames"] == 1


def test_reset_forgets_everything(ready: VirtualHost) -> None:
    assert ready.ask(58, wait_s=0.3).data == bytes((OK,))
    assert ready.ask(STATUS).data == bytes((OK, 0, 0))
    ready.send(LL_INIT, b"\x00")
    ready.firmware.reset()
    ready.run(0.1)
    assert ready.firmware.state()["mode"] == "none"


def test_silence_after_a_low_level_pulse_means_no_more_pulses(ready: VirtualHost) -> None:
    ready.ask(LL_CONFIG, config(*biphasic(250, 20)))
    ready.run(60)
    assert len(ready.pulses) == 1


class TestMidLevel:
    @pytest.fixture
    def running(self, bench: VirtualHost) -> VirtualHost:
        assert bench.ask(ML_INIT, b"\x00").data == bytes((OK,))
        assert bench.ask(ML_UPDATE, update(*biphasic(250, 20)), wait_s=0).data == bytes((OK,))
        return bench

    def test_repeats_on_its_own_grid(self, running: VirtualHost) -> None:
        start_s = running.timeline.now_s
        running.run(1.01)
        expected = [start_s + 0.025 * k for k in range(41)]
        assert [p[0] for p in running.pulses] == pytest.approx(expected)
        assert running.firmware.level == 3

    def test_keep_alive_holds_it_and_silence_stops_it_within_2_s(self, running: VirtualHost) -> None:
        for _ in range(4):
            running.run(1.9)
            ack = running.ask(ML_DATA, b"\x04", wait_s=0)
            assert ack.data == bytes((OK, 4, 1, 0, 0, 0, 0))
        alive_s = running.timeline.now_s
        running.run(10.0)
        assert alive_s + 1.97 < running.pulses[-1][0] <= alive_s + 2.0
        assert running.ask(ML_DATA, b"\x04").data == bytes((OK, 4, 0, 0, 0, 0, 0))
        assert running.firmware.level == 2

    def test_update_is_no_sign_of_life(self, running: VirtualHost) -> None:
        start_s = running.pulses[0][0]
        for _ in range(4):
            running.run(0.45)
            running.send(ML_UPDATE, update(*biphasic(100, 20)))
        running.run(1.0)
        assert start_s + 1.97 < running.pulses[-1][0] <= start_s + 2.0

    def test_update_changes_a_running_channel_on_its_grid(self, running: VirtualHost) -> None:
        running.run(0.030)
        running.send(ML_UPDATE, update(*biphasic(100, 10)))
        running.run(0.050)
        first_s = running.pulses[0][0]
        assert [w for _, w, _ in running.pulses] == [250, 250, 100, 100]
        assert running.pulses[-1][0] == pytest.approx(first_s + 0.075)

    def test_stop_and_empty_mask(self, running: VirtualHost) -> None:
        running.send(ML_UPDATE, b"\x00")
        fired = len(running.pulses)
        running.run(1.0)
        assert len(running.pulses) == fired
        assert running.ask(ML_STOP).data == bytes((OK,))
        assert running.ask(ML_UPDATE, update(*biphasic(250, 20))).data == bytes((NOT_INITIALISED,))

    def test_a_channel_with_an_open_electrode_ends_and_says_so(self, running: VirtualHost) -> None:
        running.run(0.1)
        running.electrodes.attached = False
        running.run(0.1)
        delivered = len(running.pulses)
        assert running.ask(ML_DATA, b"\x04").data == bytes((ELECTRODE, 4, 0, 1, 0, 0, 0))
        running.electrodes.attached = True
        running.run(0.2)
        assert len(running.pulses) == delivered

    def test_bad_updates_are_refused(self, running: VirtualHost) -> None:
        good = update(*biphasic(250, 20))
        settings = ({"period_ms": 0}, {"ramp": 3})
        for data in (b"", good[:-1], update(*biphasic(250, 131)), *(update(*biphasic(250, 20), **s) for s in settings)):
            assert running.ask(ML_UPDATE, data, wait_s=0).data == bytes((PARAMETER,))

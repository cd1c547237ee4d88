"""The RehaStim 2's firmware on a virtual clock."""

from __future__ import annotations

import pytest

from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2
from tests.hardware_sim.virtual_host import VirtualHost

INIT, INIT_ACK, UNKNOWN, WATCHDOG, GET_MODE, INIT_LIST, START, STOP, SINGLE, ERROR = 1, 2, 3, 4, 10, 30, 32, 34, 36, 38
OK, TRANSFER, PARAMETER, WRONG_MODE, BUSY = 0, -1, -2, -3, -8
START_MODE, INITIALISED, STARTED = 0, 1, 2


class Host(VirtualHost):
    """A RehaStim 2's, which acknowledges at once."""

    def __init__(self) -> None:
        super().__init__(stimulator="rehastim2", rate_hz=10.0)

    def packets(self, command: int) -> list[Packet]:
        return [packet for _, packet in self.sent if packet.command == command]

    def result(self, command: int, data: bytes = b"", number: int = 9) -> int:
        """The result of a command, whose ack must be the first thing that comes, at once."""
        before = len(self.sent)
        self.send(command, data, number)
        _, ack = self.sent[before]
        assert (ack.number, ack.command) == (number, command + 1)
        return int.from_bytes(ack.data[:1], "big", signed=True)

    def mode(self) -> int:
        assert self.result(GET_MODE) == OK
        return self.sent[-1][1].data[1]

    def widths(self) -> list[float]:
        return [width for _, width, _ in self.pulses]

    def times(self) -> list[float]:
        return [time for time, _, _ in self.pulses]


def pulse(width_us: int, current_ma: int, mode: int = 0) -> bytes:
    return bytes((mode,)) + width_us.to_bytes(2, "big") + bytes((current_ma,))


def setup(active: int = 1, low: int = 0, factor: int = 0, interpulse: int = 13, period: int = 48, execute: int = 0):
    return bytes((factor, active, low, interpulse)) + period.to_bytes(2, "big") + bytes((execute,))


@pytest.fixture
def bench() -> Host:
    return Host()


@pytest.fixture
def connected(bench: Host) -> Host:
    bench.run(0.5)
    bench.send(INIT_ACK, b"\x00", number=bench.sent[-1][1].number)
    assert bench.mode() == START_MODE
    return bench


@pytest.fixture
def running(connected: Host) -> Host:
    assert connected.result(INIT_LIST, setup()) == OK
    assert connected.result(START, pulse(250, 20)) == OK
    return connected


class TestConnection:
    def test_init_comes_every_500_ms_until_the_ack(self, bench: Host) -> None:
        bench.run(2.2)
        assert [time for time, _ in bench.sent] == pytest.approx([0.5, 1.0, 1.5, 2.0])
        assert [packet.command for _, packet in bench.sent] == [INIT] * 4
        assert bench.sent[0][1] == Packet(0, INIT, b"\x01")
        bench.send(INIT_ACK, b"\x00", number=bench.sent[-1][1].number)
        bench.run(1.1)
        assert len(bench.sent) == 4

    def test_a_refused_version_or_another_number_is_no_connection(self, bench: Host) -> None:
        bench.run(0.6)
        bench.send(INIT_ACK, b"\xfb", number=0)
        bench.send(INIT_ACK, b"\x00", number=77)
        bench.send(GET_MODE)
        bench.send(SINGLE, pulse(300, 24))
        assert bench.packets(GET_MODE + 1) == []
        bench.run(1.0)
        assert len(bench.packets(INIT)) == 3
        assert bench.pulses == []

    def test_watchdog_command_keeps_the_connection_without_an_ack(self, connected: Host) -> None:
        have = len(connected.sent)
        for _ in range(5):
            connected.run(1.19)
            connected.send(WATCHDOG)
        assert len(connected.sent) == have
        assert connected.mode() == START_MODE

    def test_silence_of_1200_ms_ends_modes_and_connection(self, connected: Host) -> None:
        assert connected.result(INIT_LIST, setup()) == OK
        silent_s = connected.timeline.now_s
        connected.run(1.19)
        assert connected.firmware.state()["mode"] == "initialised"
        connected.run(0.02)
        assert connected.firmware.state()["mode"] == "none"
        connected.run(0.5)
        assert connected.sent[-1][0] == pytest.approx(silent_s + 1.7)
        assert connected.sent[-1][1].command == INIT
        connected.send(INIT_ACK, b"\x00", number=connected.sent[-1][1].number)
        assert connected.mode() == START_MODE  # not where it was

    @pytest.mark.parametrize("command", [GET_MODE, WATCHDOG, INIT_LIST])
    def test_any_valid_command_is_a_sign_of_life_a_damaged_one_is_not(self, connected: Host, command: int) -> None:
        connected.run(1.0)
        connected.send(command, setup() if command == INIT_LIST else b"")
        connected.run(1.0)
        assert connected.firmware.state()["mode"] != "none"
        connected.receive(ScienceMode2.encode(Packet(1, WATCHDOG, b""))[:2] + b"\x00\x81\x57\x01\x04\x0f")
        connected.run(0.3)
        assert connected.firmware.state()["mode"] == "none"

    def test_unknown_command(self, connected: Host) -> None:
        connected.send(99, number=5)
        assert connected.sent[-1][1] == Packet(5, UNKNOWN, b"")

    def test_a_damaged_command_is_a_transfer_error(self, connected: Host) -> None:
        frame = bytearray(ScienceMode2.encode(Packet(6, SINGLE, pulse(300, 24))))
        frame[-2] ^= 0x40
        connected.receive(bytes(frame))
        assert connected.sent[-1][1] == Packet(6, SINGLE + 1, bytes((TRANSFER & 0xFF,)))
        assert connected.pulses == []
        assert connected.firmware.state()["corrupt_frames"] == 1


class TestSinglePulse:
    def test_a_pulse_is_balanced_and_flows_at_receipt(self, connected: Host) -> None:
        now_s = connected.timeline.now_s
        assert connected.result(SINGLE, pulse(300, 24)) == OK
        assert connected.pulses == [(now_s, 300.0, 24.0)]
        assert connected.electrodes.unbalanced_pulses == 0
        connected.run(1.0)
        assert len(connected.pulses) == 1

    @pytest.mark.parametrize(
        ("asked", "given"), [((300, 25), (300, 24)), ((20, 126), (20, 126)), ((500, 2), (500, 2)), ((21, 3), (21, 2))]
    )
    def test_limits_are_inclusive_and_odd_currents_sink(
        self, connected: Host, asked: tuple[int, int], given: tuple[int, int]
    ) -> None:
        assert connected.result(SINGLE, pulse(*asked)) == OK
        assert connected.pulses[0][1:] == given

    @pytest.mark.parametrize("asked", [(0, 20), (19, 20), (501, 20), (65535, 20), (250, 127), (250, 255), (300, 1)])
    def test_beyond_the_limits_and_without_current_there_is_no_pulse(self, connected: Host, asked: tuple[int, int]):
        assert connected.result(SINGLE, pulse(*asked)) == (OK if asked[1] == 1 else PARAMETER)
        assert connected.result(SINGLE, pulse(250, 20)[1:]) == PARAMETER
        assert connected.result(SINGLE, pulse(250, 20, mode=8)) == PARAMETER
        assert (connected.pulses, connected.electrodes.log) == ([], [])

    def test_start_mode_only(self, running: Host) -> None:
        assert running.result(SINGLE, pulse(300, 24)) == WRONG_MODE
        assert running.result(STOP) == OK
        assert running.result(SINGLE, pulse(300, 24)) == OK
        assert running.result(INIT_LIST, setup()) == OK
        assert running.result(SINGLE, pulse(300, 24)) == WRONG_MODE

    def test_busy_while_one_flows(self, connected: Host) -> None:
        assert connected.result(SINGLE, pulse(300, 24)) == OK
        connected.run(690e-6)
        assert connected.result(SINGLE, pulse(300, 24)) == BUSY
        connected.run(20e-6)
        assert connected.result(SINGLE, pulse(300, 24)) == OK
        assert len(connected.pulses) == 2

    def test_the_muscle_hangs_on_channel_1(self, connected: Host) -> None:
        assert connected.result(SINGLE, pulse(300, 24, mode=1)) == OK
        assert connected.pulses == []
        assert connected.packets(ERROR) == [Packet(1, ERROR, b"\xfe")]


class TestChannelList:
    def test_pulses_on_its_own_grid_and_beyond_the_hosts_silence_until_1200_ms(self, running: Host) -> None:
        start_s = running.timeline.now_s
        running.run(0.010)
        assert running.mode() == STARTED
        assert running.result(INIT_LIST, setup()) == WRONG_MODE
        running.run(10.0)
        assert running.times() == pytest.approx([start_s + 0.025 * k for k in range(49)])
        assert running.times()[-1] - start_s == pytest.approx(1.2)  # 1.19 s after the last command
        assert running.packets(ERROR) == []
        assert running.firmware.state()["mode"] == "none"

    def test_update_waits_for_the_devices_grid(self, running: Host) -> None:
        start_s = running.timeline.now_s
        running.run(0.030)
        assert running.result(START, pulse(100, 10)) == OK
        running.run(0.050)
        assert running.widths() == [250, 250, 100, 100]
        assert running.times()[-1] == pytest.approx(start_s + 0.075)

    def test_stop_ends_it_and_the_mode(self, running: Host) -> None:
        running.run(0.1)
        assert running.result(STOP) == OK
        fired = len(running.pulses)
        running.run(1.0)
        assert len(running.pulses) == fired
        assert running.mode() == START_MODE
        assert running.result(START, pulse(250, 20)) == WRONG_MODE
        assert running.result(STOP) == OK

    def test_a_bad_update_changes_nothing(self, running: Host) -> None:
        for data in (b"", pulse(501, 20), pulse(250, 127), pulse(250, 20, mode=2), pulse(250, 20) * 2, pulse(19, 20)):
            assert running.result(START, data) == PARAMETER
        running.run(0.06)
        assert running.widths() == [250, 250, 250]

    def test_a_bad_list_is_refused(self, connected: Host) -> None:
        wrong = [{"active": 0}, {"factor": 1}, {"low": 1}, {"interpulse": 12}, {"period": 13}, {"execute": 1}]
        for data in (b"", setup()[:-1], *(setup(**one) for one in wrong)):
            assert connected.result(INIT_LIST, data) == PARAMETER
            assert connected.mode() == START_MODE

    def test_several_channels_have_a_pulse_each(self, connected: Host) -> None:
        assert connected.result(INIT_LIST, setup(active=0b101)) == OK
        assert connected.result(START, pulse(250, 20)) == PARAMETER
        start_s = connected.timeline.now_s
        assert connected.result(START, pulse(250, 20) + pulse(100, 0)) == OK
        connected.run(0.049)
        assert [time - start_s for time in connected.times()] == pytest.approx([0.0, 0.025])
        assert connected.packets(ERROR) == []


class TestErrors:
    @pytest.mark.parametrize(
        ("break_it", "error"),
        [
            (lambda bench: setattr(bench.electrodes, "cut", True), -1),
            (lambda bench: setattr(bench.electrodes, "attached", False), -2),
            (lambda bench: setattr(bench.board, "high_voltage_works", False), -3),
        ],
        ids=["emergency switch", "electrode", "module"],
    )
    def test_the_device_stops_by_itself_and_says_why_once(self, running: Host, break_it, error: int) -> None:
        running.run(0.05)
        delivered = len(running.pulses)
        break_it(running)
        running.run(0.5)
        assert running.packets(ERROR) == [Packet(1, ERROR, bytes((error & 0xFF,)))]
        assert len(running.pulses) == delivered
        assert running.mode() == START_MODE
        assert running.result(SINGLE, pulse(300, 24)) == OK  # taken, then failed
        assert running.sent[-1][1] == Packet(2, ERROR, bytes((error & 0xFF,)))
        assert len(running.pulses) == delivered

    def test_reset_forgets_everything_and_offers_a_connection_anew(self, running: Host) -> None:
        running.firmware.reset()
        fired, have = len(running.pulses), len(running.sent)
        running.send(START, pulse(250, 20))
        running.run(0.6)
        assert len(running.pulses) == fired
        assert [packet for _, packet in running.sent[have:]] == [Packet(0, INIT, b"\x01")]

"""The relay matrix: its language, its times, and that it tells where its contacts are."""

from __future__ import annotations

import pytest

from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode4
from tests.hardware_sim.bench_board import LL_CONFIG, LL_INIT, biphasic, config

NO_ERROR = '0,"No error"'
ELECTRODE = 10


class Host:
    """Devices with an array, and the two lines to them."""

    def __init__(self, **settings: object) -> None:
        self.devices = make_devices(Settings(array="3", noise_nm=0.0, **settings))  # pyright: ignore[reportArgumentType]
        self._decoder = ScienceMode4()
        self.pulse(LL_INIT, b"\x00")

    def ask(self, line: str, wait_s: float = 0.02) -> str:
        self.devices.switch_received(self.devices.timeline.now_s, line.encode() + b"\n")
        self.devices.advance(self.devices.timeline.now_s + wait_s)
        return b"".join(data for _, data in self.devices.take_switch_bytes()).decode()

    def pulse(self, command: int = LL_CONFIG, data: bytes = config(*biphasic(300, 20))) -> int:
        """The result of a command to the stimulator."""
        self.devices.received(self.devices.timeline.now_s, ScienceMode4.encode(Packet(1, command, data)))
        self.devices.advance(self.devices.timeline.now_s + 0.05)
        (answer,) = [
            packet for time_s, sent in self.devices.take_bytes() for packet in self._decoder.feed(sent, time_s)
        ]
        return answer.data[0]


@pytest.fixture
def host() -> Host:
    return Host()


def test_it_says_who_it_is_and_closes_what_it_is_told(host: Host) -> None:
    assert host.ask("*IDN?").count(",") == 3
    assert host.ask("ROUT:CLOS? (@1,5,16)") == "0,0,0\n"
    assert host.ask("ROUT:CLOS (@1,5)") == ""
    assert host.ask("rout:clos? (@1,5,16)") == "1,1,0\n"
    assert host.ask("ROUTe:OPEN? (@1,5,16)") == "0,0,1\n"
    assert host.ask(":ROUT:CLOSE (@ 7 : 9)") == ""
    assert host.ask("ROUT:CLOS? (@6:10)") == "0,1,1,1,0\n"
    assert host.ask("ROUT:OPEN (@8)") == ""
    assert host.devices.state()["switch"] == {"closed": [1, 5, 7, 9], "settled": True}
    assert host.ask("ROUT:OPEN:ALL") == ""
    assert host.ask("ROUT:CLOS? (@1:16)") == ",".join("0" * 16) + "\n"
    assert host.ask("SYST:ERR?") == NO_ERROR + "\n"


def test_lines_may_come_in_pieces_and_several_at_once(host: Host) -> None:
    now_s = host.devices.timeline.now_s
    host.devices.switch_received(now_s, b"ROUT:CL")
    host.devices.switch_received(now_s, b"OS (@2)\r\n*OPC?\nROUT:CLOS? (@2)\nSYST")
    assert host.ask(":ERR?") == f"1\n1\n{NO_ERROR}\n"


def test_complete_means_settled_and_it_breaks_before_it_makes(host: Host) -> None:
    host.ask("ROUT:CLOS (@1)")
    devices, begin_s = host.devices, host.devices.timeline.now_s
    devices.switch_received(begin_s, b"ROUT:OPEN:ALL\nROUT:CLOS (@2)\n*OPC?\n")
    seen = []
    for step in range(1, 101):
        devices.advance(begin_s + step * 1e-4)
        seen.append(tuple(devices.state()["switch"]["closed"]))
    assert list(dict.fromkeys(seen)) == [(1,), (), (2,)]
    ((time_s, data),) = devices.take_switch_bytes()
    assert data == b"1\n"
    assert 0.004 < time_s - begin_s < 0.010
    assert seen[int((time_s - begin_s) / 1e-4) + 1] == (2,)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("ROUT:CLOS (@17)", -222),
        ("ROUT:CLOS (@0)", -222),
        ("ROUT:CLOS? (@1,99)", -222),
        ("ROUT:CLOS 5", -102),
        ("ROUT:CLOS (@)", -102),
        ("ROUT:CLOS", -102),
        ("ROUT:CLOS:ALL", -113),
        ("HELLO", -113),
    ],
)
def test_errors_are_queued_and_change_nothing(host: Host, line: str, code: int) -> None:
    assert host.ask(line) == ""
    assert host.devices.state()["switch"]["closed"] == []
    assert host.ask("SYST:ERR?").startswith(f"{code},")
    assert host.ask("SYST:ERR?") == NO_ERROR + "\n"


def test_a_queue_that_is_full_says_so_and_can_be_cleared(host: Host) -> None:
    for _ in range(12):
        host.ask("NONSENSE", wait_s=0.0)
    assert [host.ask("SYST:ERR?")[:4] for _ in range(11)] == ["-113"] * 9 + ["-350", '0,"N']
    host.ask("NONSENSE")
    host.ask("*CLS")
    assert host.ask("SYST:ERR?") == NO_ERROR + "\n"


def test_current_takes_the_elements_whose_relays_are_closed(host: Host) -> None:
    session = host.devices.array.session  # pyright: ignore[reportOptionalMemberAccess]
    assert host.pulse() == ELECTRODE
    assert not host.devices.electrodes.log[-1].delivered
    torques_nm = {}
    for elements in ((6,), (6, 7), (16,)):
        host.ask("ROUT:OPEN:ALL")
        host.ask(f"ROUT:CLOS (@{','.join(map(str, elements))})")
        for _ in range(60):
            assert host.pulse() == 0
        torques_nm[elements] = host.devices.load_cell.torque_nm
        expected_nm = session.truth(elements, 300.0, 20.0).torque_nm
        # every 50 ms, so that half of the time is a gap
        assert torques_nm[elements] == pytest.approx(0.5 * expected_nm, rel=0.25, abs=0.02)
    assert len({round(torque_nm, 3) for torque_nm in torques_nm.values()}) == 3
    host.ask("ROUT:OPEN:ALL")
    assert host.pulse() == ELECTRODE


def test_a_stuck_relay_is_told_by_its_contact(host: Host) -> None:
    faults = host.devices.faults
    host.ask("ROUT:CLOS (@3)")
    faults.on("switch_relay_stuck", {"relay": 3.0, "closed": True})
    host.ask("ROUT:OPEN:ALL")
    assert host.ask("ROUT:CLOS? (@3)") == "1\n"
    assert host.pulse() == 0
    faults.on("switch_relay_stuck", {"relay": 3.0, "closed": False})
    host.ask("ROUT:CLOS (@3)")
    assert host.ask("ROUT:CLOS? (@3,4)") == "0,0\n"
    assert host.pulse() == ELECTRODE
    faults.off("switch_relay_stuck")
    assert host.ask("ROUT:CLOS? (@3,4)") == "1,0\n"


def test_no_answer_and_a_wrong_one(host: Host) -> None:
    faults = host.devices.faults
    faults.on("switch_silent", {})
    assert host.ask("ROUT:CLOS (@3)") == host.ask("*OPC?") == ""
    faults.off("switch_silent")
    faults.on("switch_wrong_answer", {})
    assert host.ask("ROUT:CLOS? (@3)") == "0\n"
    faults.off("switch_wrong_answer")
    assert host.ask("ROUT:CLOS? (@3)") == "1\n"


@pytest.mark.parametrize("relay", [0.0, 1.5, 17.0])
def test_a_relay_that_is_not_there_cannot_stick(host: Host, relay: float) -> None:
    with pytest.raises(HardwareSimError, match="1 to 16"):
        host.devices.faults.on("switch_relay_stuck", {"relay": relay})


def test_power_lost_opens_all_and_forgets(host: Host) -> None:
    host.ask("ROUT:CLOS (@3)")
    host.devices.switch_received(host.devices.timeline.now_s, b"ROUT:CLOS (@4)\n*OPC?\nSYS")
    host.devices.power_cycle()
    assert host.ask("SYST:ERR?") == NO_ERROR + "\n"
    assert host.devices.state()["switch"]["closed"] == []


def test_clinician_and_person_are_asked_of_the_last_pulse(host: Host) -> None:
    array = host.devices.array
    assert array is not None
    assert array.asked() == {"elements": []}
    host.ask("ROUT:CLOS (@6,7)")
    host.pulse()
    told = array.asked()
    assert told["elements"] == [6, 7]
    assert (told["width_us"], told["current_ma"]) == (300.0, 20.0)
    assert told["spill"] in (0, 1, 2) and 0 <= told["comfort"] <= 10
    assert set(told["truth"]) == {"torque_nm", "spill", "pain"}


@pytest.mark.parametrize("described", [{"array": "x"}, {"array": "1:"}, {"patient": "calcium", "array": "1"}])
def test_settings_that_make_no_array(described: dict[str, str]) -> None:
    with pytest.raises(HardwareSimError, match="--array"):
        make_devices(Settings(**described))  # pyright: ignore[reportArgumentType]

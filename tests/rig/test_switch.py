"""The relay matrix and the one place that moves its relays: never under current, confirmed, in the journal before."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig import journal
from stimrig.rig.devices import scpi_matrix
from stimrig.rig.errors import DeviceError, RefusedError, RigError
from stimrig.rig.journal import Kind
from stimrig.rig.messages import ChannelPlan
from stimrig.rig.relays import Relays
from tests.rig.fakes import VirtualRig, hold, rest
from tests.rig.test_channels import BASE, BICEPS, RIG, both, on_both, planned, two
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

SETTLES_S = 0.005


class Matrix:
    """A relay matrix at the end of a line; its faults are attributes. It notes when a relay moved."""

    def __init__(self, clock: VirtualClock, relays: int = 8) -> None:
        self.clock, self.count = clock, relays
        self.closed: set[int] = set()
        self.moved: list[tuple[float, tuple[int, ...]]] = []
        self.asked: list[str] = []
        self.silent = self.full = self.deaf = False
        self.stuck: set[int] = set()
        self.errors: list[str] = []
        self._moves_until_s = 0.0
        self._rest = b""

    def open(self, on_bytes: Callable[[bytes, float], None], on_lost: Callable[[str], None]) -> None:
        self.on_bytes, self.lose = on_bytes, on_lost

    def close(self) -> None: ...

    def discard(self) -> None: ...

    def write(self, data: bytes) -> int:
        if self.full:
            return 0
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._obey(line.decode())
        return len(data)

    def _obey(self, line: str) -> None:
        self.asked.append(line)
        numbers = {int(n) for n in re.findall(r"\d+", line.partition("@")[2])}
        if self.silent or (self.deaf and not line.startswith("ROUT:CLOS?") and line.startswith("ROUT")):
            return
        if numbers and not max(numbers) <= self.count:
            self.errors.append('-222,"Data out of range"')
        elif line == "ROUT:OPEN:ALL":
            self._move(self.stuck & self.closed)
        elif line.startswith("ROUT:CLOS ("):
            self._move(self.closed | numbers)
        elif line.startswith("ROUT:CLOS?"):
            self._say(",".join("1" if n in self.closed else "0" for n in sorted(numbers)))
        elif line == "*IDN?":
            self._say("Maker,M1,123,1.0")
        elif line == "*OPC?":
            self._say("1", max(0.0, self._moves_until_s - self.clock.now_s()))
        elif line == "SYST:ERR?":
            self._say(self.errors.pop(0) if self.errors else '0,"No error"')
        else:
            self.errors.append('-113,"Undefined header"')

    def _move(self, closed: set[int]) -> None:
        if closed != self.closed:
            self.moved.append((self.clock.now_s(), tuple(sorted(closed))))
            self._moves_until_s = self.clock.now_s() + SETTLES_S
        self.closed = closed

    def _say(self, answer: str, after_s: float = 0.0) -> None:
        data = f"{answer}\n".encode()
        half = len(data) // 2
        for part, at_s in ((data[:half], 0.0005), (data[half:], 0.001)):
            at = self.clock.now_s() + after_s + at_s
            self.clock.call_at(at, lambda part=part: self.on_bytes(part, self.clock.now_s()))


def switch_of(machine: VirtualMachine, matrix: Matrix, **more: Any) -> scpi_matrix.ScpiMatrix:
    machine.port = lambda *_args, **_more: matrix  # type: ignore[method-assign]
    given = {"device": "scpi_matrix", "port": "/dev/matrix", "channel": "biceps", "elements": matrix.count, **more}
    return scpi_matrix.create(scpi_matrix.Settings(**given), machine)


@pytest.fixture
def alone() -> tuple[VirtualMachine, Matrix, scpi_matrix.ScpiMatrix]:
    machine = VirtualMachine()
    matrix = Matrix(machine.clock)
    return machine, matrix, switch_of(machine, matrix)


def opened(alone: tuple[VirtualMachine, Matrix, scpi_matrix.ScpiMatrix], lost: list[str] | None = None) -> None:
    machine, _, switch = alone
    machine.run(switch.open((lost if lost is not None else []).append))


class TestMatrix:
    def test_what_it_says(self, alone: Any) -> None:
        machine, matrix, switch = alone
        found = machine.run(switch.open(lambda _: None))
        assert found == {
            "device": "scpi_matrix", "id": "123", "firmware": "1.0", "port": "/dev/matrix", "model": "Maker M1",
            "channel": "biceps", "elements": 8,
        }  # fmt: skip
        assert matrix.asked == ["*IDN?"]
        machine.run(switch.connect((5, 1)))
        assert matrix.closed == {1, 5}
        every = "ROUT:CLOS? (@1,2,3,4,5,6,7,8)"
        told = ["ROUT:OPEN:ALL", "*OPC?", "SYST:ERR?", every, "ROUT:CLOS (@5,1)", "*OPC?", "SYST:ERR?", every]
        assert matrix.asked[1:] == told

    def test_others_are_opened_first(self, alone: Any) -> None:
        machine, matrix, switch = alone
        opened(alone)
        machine.run(switch.connect((1,)))
        machine.run(switch.connect((2, 3)))
        assert [closed for _, closed in matrix.moved] == [(1,), (), (2, 3)]
        for (one_s, _), (other_s, _) in itertools.pairwise(matrix.moved[1:]):
            assert other_s - one_s >= SETTLES_S, "break before make"

    @pytest.mark.parametrize(
        ("fault", "words"),
        [
            ({"silent": True}, "no answer"),
            ({"full": True}, "the line is full"),
            ({"deaf": True, "closed": {2}}, "asked to open all relays"),
            ({"deaf": True}, "asked to connect (@5)"),
            ({"stuck": {7}, "closed": {7}}, "asked to open all relays"),
            ({"errors": ['-222,"Data out of range"']}, "Data out of range"),
            ({"count": 3}, "no answer"),
        ],
    )
    def test_what_is_not_as_asked_is_an_error(self, alone: Any, fault: dict[str, Any], words: str) -> None:
        machine, matrix, switch = alone
        opened(alone)
        vars(matrix).update(fault)
        with pytest.raises(DeviceError, match=r"switch /dev/matrix:.*") as told:
            machine.run(switch.connect((5,)))
        assert words in str(told.value)

    def test_a_lost_line(self, alone: Any) -> None:
        machine, matrix, switch = alone
        lost: list[str] = []
        opened(alone, lost)
        matrix.lose("unplugged")
        assert lost == ["switch /dev/matrix: unplugged"]
        with pytest.raises(DeviceError, match="unplugged"):
            machine.run(switch.open_all())


SWITCHED = (replace(RIG[0], elements=8), RIG[1])


def with_elements(*elements: int) -> list[ChannelPlan]:
    return [ChannelPlan(name="biceps", profile=BICEPS, elements=list(elements)), both()[1]]


class TestPlans:
    @pytest.mark.parametrize(
        ("elements", "words"),
        [((), "name one element or a pair"), ((0,), "from 1 to 8"), ((9,), "from 1 to 8"), ((2, 2), "different ones")],
    )
    def test_wrong_elements(self, tmp_path: Path, elements: tuple[int, ...], words: str) -> None:
        with pytest.raises(RefusedError, match=words):
            two(tmp_path, channels=with_elements(*elements), rig=SWITCHED)

    def test_more_than_a_pair(self) -> None:
        with pytest.raises(ValueError, match="at most 2"):
            with_elements(1, 2, 3)

    def test_a_test_that_names_no_channel(self, tmp_path: Path) -> None:
        with pytest.raises(RigError, match="biceps has a switch"):
            VirtualRig(tmp_path, [hold()], base=BASE, rig=SWITCHED)

    def test_elements_without_a_switch(self) -> None:
        with pytest.raises(RefusedError, match="no switch"):
            planned([on_both()], channels=with_elements(1))


class Switched:
    """A test over the matrix."""

    def __init__(self, folder: Path, *elements: int) -> None:
        self.rig = rig = two(folder, [rest(0.5), on_both(), rest(0.5)], channels=with_elements(*elements), rig=SWITCHED)
        self.matrix = Matrix(rig.clock)
        self.lost: list[str] = []
        self.switch = switch_of(rig.machine, self.matrix)
        self.relays = Relays(self.switch, rig.gate, rig.clock)
        rig.machine.run(self.relays.open(lambda reason: void(rig.halt.set("fault", reason))))
        rig.run._relays = self.relays
        self.matrix.moved.clear()

    def events(self) -> list[dict[str, Any]]:
        found = [json.loads(p) for k, p in journal.read(self.rig.path).blocks if k == Kind.EVENT]
        return [event for event in found if event["event"].startswith("relays")]


def void(*_: object) -> None: ...


class TestRuns:
    def test_relays_move_before_and_after(self, tmp_path: Path) -> None:
        test = Switched(tmp_path, 3, 4)
        order: list[str] = []
        stimulator, write = test.rig.stimulator, test.matrix.write
        arm, stop = stimulator.arm, stimulator.stop

        async def noted(name: str, action: Callable[[], Any]) -> None:
            order.append(name)
            await action()

        stimulator.arm = lambda: noted("arm", arm)  # type: ignore[method-assign]
        stimulator.stop = lambda: noted("stop", stop)  # type: ignore[method-assign]

        def spied(data: bytes) -> int:
            if data.startswith((b"ROUT:CLOS (", b"ROUT:OPEN")):
                order.append(data.decode().strip())
                assert not test.rig.gate.is_open
                told = "relays" if data.startswith(b"ROUT:CLOS") else ""
                assert not told or test.events()[-1]["event"] == told, "in the journal before"
            return write(data)

        test.matrix.write = spied  # type: ignore[method-assign]
        result = test.rig.execute()
        assert result.outcome == "completed", result.reason
        assert order == ["ROUT:OPEN:ALL", "ROUT:CLOS (@3,4)", "arm", "stop", "ROUT:OPEN:ALL"]
        assert test.matrix.closed == set()
        assert [(e["event"], e["elements"]) for e in test.events()] == [
            ("relays", [3, 4]),
            ("relays_set", [3, 4]),
            ("relays_open", []),
        ]
        sent_s = [s for s, _ in test.rig.stimulator.sent]
        assert len(sent_s) == 80
        assert not any(sent_s[0] <= moved_s <= sent_s[-1] + 0.0011 for moved_s, _ in test.matrix.moved)
        said = json.loads(test.rig.recording().attributes["channels"])
        assert [one["elements"] for one in said] == [[3, 4], []]

    @pytest.mark.parametrize("fault", [{"silent": True}, {"stuck": {7}, "closed": {7}}, {"deaf": True}])
    def test_without_the_relays_nothing_begins(self, tmp_path: Path, fault: dict[str, Any]) -> None:
        test = Switched(tmp_path, 3)
        vars(test.matrix).update(fault)
        result = test.rig.execute()
        assert result.outcome == "fault"
        assert "switch /dev/matrix" in result.reason
        assert test.rig.stimulator.sent == []

    def test_relays_that_stay_closed_are_a_fault(self, tmp_path: Path) -> None:
        test = Switched(tmp_path, 3)
        test.matrix.stuck = {3}
        result = test.rig.execute()
        assert result.outcome == "fault"
        assert "asked to open all relays" in result.reason
        assert not result.evidence.confirmed

    def test_without_a_confirmed_stop_no_relay_moves(self, tmp_path: Path) -> None:
        test = Switched(tmp_path, 3)
        test.rig.at(0.8, lambda: setattr(test.rig.stimulator, "silent", True))
        test.rig.at(0.8, lambda: test.rig.halt.set("stopped", "x"))
        result = test.rig.execute()
        assert not result.evidence.confirmed
        assert test.matrix.closed == {3}

    def test_a_stop_opens_them(self, tmp_path: Path) -> None:
        test = Switched(tmp_path, 3)
        test.rig.at(0.8, lambda: test.rig.halt.set("stopped", "x"))
        result = test.rig.execute()
        assert (result.outcome, result.evidence.confirmed, test.matrix.closed) == ("stopped", True, set())
        assert test.matrix.moved[-1][0] >= test.rig.stimulator.acked_s[-1]

    def test_a_switch_that_is_lost_ends_a_test(self, tmp_path: Path) -> None:
        test = Switched(tmp_path, 3)
        test.rig.at(0.8, lambda: test.matrix.lose("unplugged"))
        result = test.rig.execute()
        assert (result.outcome, result.reason) == ("fault", "switch /dev/matrix: unplugged")

    @pytest.mark.parametrize("open_gate", [True, False])
    def test_they_never_move_under_current(self, tmp_path: Path, open_gate: bool) -> None:
        """Whoever asks, while the gate is open, or a pulse may still be felt."""
        test = Switched(tmp_path, 3)
        if not open_gate:
            test.rig.stimulator.ack_delay_s = 0.05
        told: list[str] = []

        def move() -> None:
            assert test.rig.gate.is_open or test.rig.gate.on_its_way
            if not open_gate:
                test.rig.gate.shut()
            before, asked = set(test.matrix.closed), len(test.matrix.asked)
            for action in (
                lambda: test.relays.open_all(),
                lambda: test.relays.connect((1,), test.rig.journal),
                lambda: test.relays.open(void),
            ):
                task = test.rig.machine.tasks.begin(action(), "mistaken")
                told.append(str(task.error))
            assert (test.matrix.closed, len(test.matrix.asked)) == (before, asked)

        test.rig.at(0.8015, move)
        test.rig.execute()
        assert told == ["switch: relays must not move while a pulse may flow; they were left as they are"] * 3

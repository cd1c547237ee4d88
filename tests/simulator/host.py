"""The rig's computer: a clock of its own, pauses, and one rig process after the other."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from stimrig.rig.machine import Bus, Disk, Port
from stimrig.rig.tasks import Outcome, Tasks
from tests.simulator.disk import SimulatedDisk
from tests.simulator.virtual_time import QuietMachine
from tests.simulator.world import World

if TYPE_CHECKING:
    from tests.simulator.wires import Wires

BORN_S = 5000.0
"""What the computer's monotonic clock shows at the world's time 0."""


class DiedInAStep(BaseException):
    """A process was killed where it touched a port or a file: no program catches it."""


class Computer:
    """A clock that drifts, and the pauses during which nothing runs on it.

    While a step of the rig's program is stalled, its own time goes on and the world's does not: what it does then
    reaches the others later.
    """

    def __init__(self, world: World, drift_ppm: float, unix_s: float) -> None:
        self.world = world
        self.speed = 1.0
        self.boots = 1
        self.paused_until_s = 0.0
        self.pauses: list[tuple[float, float]] = []
        self.stalls: list[tuple[float, float]] = []
        """Within a step: when, and for how long."""
        self.lag_s = 0.0
        """How far the step that runs now is ahead of the world."""
        self.stall_next_s = 0.0
        """How long the next access to a port or a file takes."""
        self.dies_next = self.in_a_step = self.dying = False
        """Whether the process dies at that access; whether one of its tasks runs; whether it died in this step."""
        self._rate = 1 + drift_ppm * 1e-6
        self._unix_s = unix_s

    @property
    def true_s(self) -> float:
        """The world's time at which the running step is."""
        return self.world.now_s + self.lag_s

    def now_s(self) -> float:
        self._end_if_dying()
        return BORN_S + self.true_s * self._rate

    def unix_s(self) -> float:
        return self._unix_s + self.true_s

    def set_wall_clock(self, by_s: float) -> None:
        """The wall clock jumps; the monotonic one does not."""
        self._unix_s += by_s

    def true_at(self, clock_s: float) -> float:
        """The world's time at which this clock shows `clock_s`."""
        return (clock_s - BORN_S) / self._rate if clock_s < math.inf else math.inf

    def pause(self, duration_s: float) -> None:
        """Nothing runs for a while."""
        self.paused_until_s = max(self.paused_until_s, self.world.now_s + duration_s)
        self.pauses.append((self.world.now_s, self.paused_until_s))

    def access(self) -> None:
        """A step touches a port or a file: here it may be stalled, or be its last."""
        if self.dies_next and self.in_a_step:
            self.dies_next, self.dying = False, True
        self._end_if_dying()
        if self.stall_next_s:
            self.stalls.append((self.true_s, self.stall_next_s))
            self.lag_s, self.stall_next_s = self.lag_s + self.stall_next_s, 0.0

    def _end_if_dying(self) -> None:
        """What the program does on its way out (`finally`) and the tasks after it do nothing any more."""
        if self.dying:
            raise DiedInAStep


class Process(QuietMachine):
    """One process on the computer: its tasks run as long as it lives."""

    def __init__(self, computer: Computer, disk: SimulatedDisk, ports: Wires) -> None:
        self.computer, self.world, self.alive = computer, computer.world, True
        self.listens = False
        """Whether it takes requests: not before its devices were tried."""
        self.tasks = Tasks(computer, self._work)
        self.disk: Disk = disk
        self.boot_id = f"boot-{computer.boots}"
        self.on_death: Callable[[], None] = lambda: None
        """Called as it dies by itself."""
        self.works = 0
        """Pieces of work, of the disk for the most part, that are under way."""
        self._ports, self._simulated_disk = ports, disk
        self._inbox: list[Callable[[], None]] = []
        self._wake_s = math.inf
        self._turns = 0

    def post(self, action: Callable[[], None]) -> None:
        """Something came for this process."""
        if self.alive:
            self._inbox.append(action)
            self._wake_at(self.world.now_s)

    def kill(self) -> None:
        """It runs no step more; what it wrote stays."""
        self.alive = False

    def port(self, path: str, **_arguments: Any) -> Port:
        return self._ports.port(self, path)

    def open_bus(self, arguments: dict[str, Any], name: str) -> Bus:
        return self._ports.open_bus(self, arguments, name)

    def shared_bus(self, arguments: dict[str, Any], name: str) -> Bus | None:  # noqa: ARG002
        return self._ports.shared_bus(self)

    def new_id(self) -> str:
        return f"{self.world.chance.getrandbits(128):032x}"

    def _wake_at(self, true_s: float) -> None:
        if true_s < self._wake_s:
            self._wake_s = true_s
            self._turns += 1
            turn = self._turns
            self.world.at(true_s, lambda: self._turn(turn))

    def _turn(self, turn: int) -> None:
        if not self.alive or turn != self._turns:
            return
        self._wake_s = math.inf
        computer = self.computer
        if self.world.now_s < computer.paused_until_s:
            self._wake_at(computer.paused_until_s)
            return
        inbox, self._inbox = self._inbox, []
        computer.in_a_step = True
        try:
            for action in inbox:
                action()
            next_s = computer.true_at(self.tasks.run())
        except DiedInAStep:
            for task in self.tasks._ready:
                if inspect.getcoroutinestate(task._coroutine) == inspect.CORO_CREATED:
                    task._coroutine.close()
            died_s = computer.paused_until_s = max(computer.paused_until_s, computer.true_s)
            computer.dying, computer.lag_s = False, 0.0
            self.world.at(died_s, self.on_death)
            return
        finally:
            computer.in_a_step = False
        if computer.lag_s:
            computer.paused_until_s = max(computer.paused_until_s, computer.true_s)
            computer.lag_s = 0.0
        if next_s < math.inf or self._inbox:
            self._wake_at(max(next_s, computer.paused_until_s, self.world.now_s))

    def _work(self, action: Callable[[], Any], outcome: Outcome) -> None:
        """Done early or late in the time that it takes: a death in between finds it done, or not."""
        takes_s = self._simulated_disk.work_s()
        early = self.world.chance.random() < 0.5
        done: list[tuple[Any, BaseException | None]] = []
        self.works += 1

        def do() -> None:
            if self.alive:
                done.append(_tried(action))

        def tell() -> None:
            if not early:
                do()
            self.works -= 1
            if done:
                self.post(lambda: outcome(*done[0]))

        true_s = self.computer.true_s
        if early:
            self.world.at(true_s, do)
        self.world.at(true_s + takes_s, tell)


def _tried(action: Callable[[], Any]) -> tuple[Any, BaseException | None]:
    try:
        return action(), None
    except Exception as error:
        return None, error

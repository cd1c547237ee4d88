"""One life of a rig: some tests, some people, some accidents, and a quiet end; all of it from one seed."""

from __future__ import annotations

import math
import random
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.load_cells.cells import CELLS, WithAngle
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators import STIMULATORS
from stimrig.rig import config
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import RigError
from stimrig.rig.messages import Profile
from tests.simulator import accidents
from tests.simulator.clinic import Clinic
from tests.simulator.disk import SimulatedDisk
from tests.simulator.host import Computer, Process
from tests.simulator.people import People
from tests.simulator.wires import Wires
from tests.simulator.world import World

FOLDER = Path("/rig")
LASTS_S = 8.0
"""How long accidents and people go on."""
QUIET_S = 20.0
"""The longest that the rig may then need until it has played one more test."""
HELD, ROBOT = "held", "robot,from_deg=60,to_deg=110,deg_s=60,pause_s=0.2"


class Felt(NamedTuple):
    """A pulse that the stimulator fired: when, when its command was written (both in the world's time), and whether the
    command came as it was sent."""

    time_s: float
    width_us: float
    current_ma: float
    balanced: bool
    written_s: float
    true: bool
    output: tuple[int, int]  # connector and channel, from 0


def rig_file(settings: Settings, devices: Devices, arm: str | None) -> config.RigConfig:
    """Describe these devices as a rig file does."""
    content = {
        "require_calibration": False,
        "stimulator": {"device": settings.stimulator, "port": "/dev/simulated"},
        "load_cell": {
            "device": "can_load_cell", "bus": {"interface": "simulated"}, "sample_rate_hz": settings.rate_hz,
            **devices.load_cell.cell.rig_keys,
        },
        "angle_sensor": {"device": "can_angle_sensor", "offset": 30.0, "direction": -1} if arm else None,
    }  # fmt: skip
    return config.check(content, "simulated", data_dir=FOLDER, socket=FOLDER / "socket")


class Life:
    """Builds the rig of a seed and lives it.

    `only`: numbers of the accidents that happen; None: all. A failing life is shrunk by leaving some out.
    """

    def __init__(self, seed: int, only: Collection[int] | None = None) -> None:
        self.world = world = World(seed)
        chance = random.Random(f"life {seed}")
        self.profile = Profile(
            current_ma=chance.choice((8.0, 20.0, 40.0)), max_pulse_width_us=chance.choice((120.0, 300.0, 500.0)),
            max_torque_nm=chance.choice((9.0, 30.0)),
        )  # fmt: skip
        self.rate_hz = chance.choice((20.0, 40.0, 50.0))
        self.adaptive = chance.random() < 0.3
        cells = set(CELLS) - {WithAngle.name}  # whose angle would be one more
        settings = Settings(
            stimulator=chance.choice(tuple(STIMULATORS)), cell=chance.choice(("plain", *sorted(cells, reverse=True))),
            rate_hz=chance.choice((200.0, 200.0, 400.0, 1600.0)), noise_seed=seed & 0xFFFF,
            clock_ppm=chance.uniform(-200, 200), angle_offset_deg=30.0, angle_direction=-1,
            angle_clock_ppm=chance.uniform(-200, 200),
        )  # fmt: skip
        self.arm = chance.choice((None, None, None, None, HELD, ROBOT))
        """What holds or moves the joint, where the rig has an angle sensor."""
        self.devices = make_devices(settings, self.arm, epoch_us=1_700_000_000_000_000)
        self.disk = SimulatedDisk(world)
        self.computer = Computer(world, chance.uniform(-100, 100), 1_764_000_000.0)
        self.disk.access = self.computer.access
        self.felt: list[Felt] = []
        self.wires = Wires(world, self.devices, chance.choice((0.01, 0.02, 0.03)), self._note)
        self.clinic = Clinic(world, self.devices.state)
        self.clinic.kill = lambda: self.kill(0.3)
        self.befallen: list[str] = []
        """What befell it, as the trace tells it."""
        self.past: list[tuple[Process, Rig]] = []
        """Kept to the end: as Python tidies a task up, its `finally` would write for a process that is dead."""
        self.deaths: list[float] = []
        self.died_writing: list[float] = []
        """Those of the deaths during which a piece of work was under way."""
        self.power_failures: list[tuple[float, float]] = []
        """When, and since when the disk was well; infinite: it was not."""
        self._config = rig_file(settings, self.devices, self.arm)
        self.quiet = False
        self._plan_accidents(chance, only)
        self.begin_process()
        self.people = People(self, set())
        self.others = [People(self, self.people.jumping, leads=False) for _ in range(chance.choice((0, 1, 1, 2, 3)))]

    def live(self) -> None:
        """From the first start to the last test."""
        self.world.run(LASTS_S)
        self._calm()
        end_s = LASTS_S + QUIET_S
        while not self.people.saw_one_end and self.world.now_s < end_s:
            self.world.run(self.world.now_s + 0.5)
        self.world.run(self.world.now_s + 0.5)

    # -- processes

    def begin_process(self) -> None:
        """A rig process starts."""
        process = Process(self.computer, self.disk, self.wires)
        process.on_death = lambda: self.kill(0.3)
        rig = Rig(self._config, process, lambda event: self.clinic.hear(process, event))
        self.past.append((process, rig))
        self.clinic.meet(process, rig)
        self.world.tell("host", "the rig's process starts")

        async def open_rig() -> None:
            try:
                await rig.open()
            except RigError as error:
                self.world.tell("host", f"the rig's process ends: {error}")
                self.world.at(process.computer.true_s, lambda: self.kill(1.0))
            else:
                process.listens = True

        process.post(lambda: process.tasks.spawn(open_rig(), "open"))

    def kill(self, again_after_s: float) -> None:
        """The process dies now."""
        process = self.clinic.process
        if process is not None and process.alive:
            process.kill()
            self.disk.process_ended()
            self.deaths.append(self.world.now_s)
            if process.works:
                self.died_writing.append(self.world.now_s)
            self.world.after(again_after_s, self.begin_process)

    def power_failure(self, again_after_s: float) -> None:
        """The computer loses its power."""
        if self.clinic.process is not None and self.clinic.process.alive:
            self.kill(again_after_s)
            self.disk.power_failure()
            self.power_failures.append((self.world.now_s, self.disk.well_since_s if self.disk.is_well else math.inf))
            self.computer.boots += 1

    def end_process(self) -> None:
        """Asked to end; a new one starts once it has."""
        process, rig = self.clinic.process, self.clinic.rig
        if process is None or rig is None or not process.alive or not process.listens:
            return

        async def end() -> None:
            await rig.close()
            self.world.at(process.computer.true_s, ended)

        def ended() -> None:
            if process.alive:
                self.kill(0.3)

        process.post(lambda: process.tasks.spawn(end(), "end"))

    # -- healing

    def heal_requests(self) -> None:
        """Nothing is lost any more."""
        self.clinic.loses = 0.0

    def _calm(self) -> None:
        self.world.tell("life", "no more accidents")
        self.quiet = True
        self.disk.heal()
        self.heal_requests()
        for way in (self.wires.to_device, self.wires.to_host):
            way.odds.clear()
        for name in self.devices.faults.active():
            self.devices.faults.off(name)
        self.computer.stall_next_s, self.computer.dies_next = 0.0, False

    # -- set-up

    def _note(self, written_s: float, true: bool) -> None:
        for pulse in self.devices.electrodes.log[len(self.felt) :]:
            how = pulse.time_s, pulse.width_us, pulse.current_ma, pulse.balanced
            self.felt.append(Felt(*how, written_s, true, pulse.output))
            deviant = "" if true else ", of a piece that came changed"
            self.world.tell("electrode", f"{pulse.width_us:g} µs {pulse.current_ma:g} mA{deviant}", pulse.time_s)

    def _plan_accidents(self, chance: random.Random, only: Collection[int] | None) -> None:
        names = list(accidents.LIBRARY)
        odds = [accidents.ODDS.get(name, 1.0) for name in names]
        self.accidents = 1 + int(chance.expovariate(0.12))
        for number in range(self.accidents):
            time_s, name = chance.uniform(0.0, LASTS_S), chance.choices(names, odds)[0]
            if only is None or number in only:
                self.world.at(time_s, lambda number=number, name=name: self._befall(number, name))

    def _befall(self, number: int, name: str) -> None:
        own = random.Random(f"{self.world.seed} {number}")
        words = accidents.LIBRARY[name](self, own)
        self.world.faults += 1
        self.befallen.append(f"{name} {words}".rstrip())
        self.world.tell("accident", f"{number} {self.befallen[-1]}")

"""A check of a rig in simulated time: the rig's own code, emulated devices, hands that do what a person does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.settings import Settings
from stimrig.rig import config
from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Finding
from stimrig.rig.check.person import Hands, Person, Scripted
from stimrig.rig.check.running import run
from stimrig.rig.check.surroundings import Surroundings
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Bus
from tests.simulator.disk import SimulatedDisk
from tests.simulator.host import Computer, Process
from tests.simulator.wires import SimulatedPort, Wires
from tests.simulator.world import World

FOLDER = Path("/rig")
STIMULATOR, ADAPTER = "/dev/stimrig/stimulator", "/dev/stimrig/slcan"
BLOCK_S = 0.02
LONGEST_S = 120.0
NAMES = ("biceps", "triceps")


@dataclass
class Planted:
    """A rig, with what is wrong with it.

    `settings`: of the emulator; `faults`: of the emulator, on from the start; `rig_file`: keys that are put into the
    rig file; `system`: what the system says, by the names of `Surroundings`; `world`: changes anything else;
    `dead_switch`: the emergency stop does nothing; `fault`: what must be told; empty: the rig is sound.
    """

    name: str
    fault: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    faults: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    rig_file: Mapping[str, Any] = field(default_factory=dict)
    system: Mapping[str, Any] = field(default_factory=dict)
    world: Callable[[Checked], None] = lambda _: None
    arm: str | None = None
    channels: Sequence[int] = ()
    dead_switch: bool = False


class System(Surroundings):
    """A sound one, but for what is planted."""

    def __init__(self, planted: Mapping[str, Any]) -> None:
        self._planted = planted

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("_"):
            return super().__getattribute__(name)
        sound = {
            "real": None,
            "exists": True,
            "may_use": True,
            "holder": "",
            "latency_ms": None,
            "can_link": {"up": True},
        }

        def look(path: str) -> Any:
            planted = self._planted.get(name, {})
            return planted.get(path, path if name == "real" else sound[name])

        return look


class NamedWires(Wires):
    """Wires whose ports have names: a name that is not the stimulator's leads to nothing that answers."""

    locked = False

    def open_port(self, port: SimulatedPort) -> None:
        if self.locked:
            raise DeviceError(f"stimulator.port: {port.path} cannot be opened (locked); is another program using it?")
        if port.path == STIMULATOR:
            super().open_port(port)

    def open_bus(self, process: Process, arguments: dict[str, Any], name: str) -> Bus:
        bus = super().open_bus(process, arguments, name)
        if arguments.get("channel") not in (ADAPTER, "can0"):
            self._bus = None  # it opens, and nothing comes
        return bus


class Checked:
    """One check of a planted rig, lived through at once; `report` is its result."""

    def __init__(
        self, planted: Planted, seed: int = 1, noise_nm: float = 0.05, answers: Mapping[str, str] | None = None
    ) -> None:
        self.planted, self.world = planted, World(seed)
        values = {"noise_seed": seed, "noise_nm": noise_nm, "rate_hz": 200.0, **planted.settings}
        self.settings = Settings(**values)
        self.devices: Devices = make_devices(self.settings, planted.arm, epoch_us=1_700_000_000_000_000)
        if planted.channels:
            muscle = next(iter(self.devices.electrodes.wired.values()))
            self.devices.electrodes.wired = {(0, one): muscle for one in range(len(planted.channels))}
        self.disk, self.computer = SimulatedDisk(self.world), Computer(self.world, 20.0, 1_764_000_000.0)
        self.wires = NamedWires(self.world, self.devices, BLOCK_S, lambda *_: None)
        for name, settings in planted.faults.items():
            self.devices.faults.on(name, dict(settings))
        planted.world(self)
        self.told: list[tuple[str, Finding]] = []
        self.answers = answers or {}
        self.config = self._config()
        self.process = Process(self.computer, self.disk, self.wires)
        self.bench = Bench(
            self.config, self.process, self._hands(), System(planted.system), self.computer.pause, emulated=False
        )
        self.report = self._run()

    @property
    def found(self) -> list[str]:
        """The faults that were told."""
        return [row["fault"] for row in self.report["steps"] if row["fault"]]

    def _run(self) -> dict[str, Any]:
        done: list[Any] = []

        async def check() -> None:
            try:
                done.append(await run(self.bench, 30.0, {}, lambda title, finding: self.told.append((title, finding))))
            except BaseException as error:
                done.append(error)
                raise

        def begin() -> None:
            self.process.tasks.spawn(check(), "check")

        self.process.post(begin)
        while not done and self.world.now_s < LONGEST_S:
            self.world.run(self.world.now_s + 0.5)
        assert done, (self.world.now_s, self.told)
        if isinstance(done[0], BaseException):
            raise done[0]
        return done[0]

    def _config(self) -> config.RigConfig:
        slcan = self.settings.transport == "slcan"
        bus = {"interface": "slcan", "channel": ADAPTER} if slcan else {"interface": "socketcan", "channel": "can0"}
        named = [
            {"name": NAMES[n], "muscle": NAMES[n], "side": "right", "channel": c}
            for n, c in enumerate(self.planted.channels)
        ]
        content: dict[str, Any] = {
            "stimulator": {"device": self.settings.stimulator, "port": STIMULATOR},
            "load_cell": {
                "device": "can_load_cell", "bus": bus, "sample_rate_hz": self.settings.rate_hz,
                **self.devices.load_cell.cell.rig_keys,
            },
            "angle_sensor": {"device": "can_angle_sensor"} if self.planted.arm else None,
        }  # fmt: skip
        if named:
            content["stimulator"]["channels"] = named
        for key, value in self.planted.rig_file.items():
            table, _, name = key.partition(".")
            content.setdefault(table, {})[name] = value
        return config.check(content, "rig.toml", data_dir=FOLDER, socket=FOLDER / "socket")

    def _hands(self) -> Person:
        outputs = {name: (0, n) for n, name in enumerate(NAMES[: len(self.planted.channels)])} or {
            "": self.settings.wired[0]
        }
        return Scripted(self.answers, Hands(self._control, outputs))

    def _control(self, cmd: str, **request: Any) -> dict[str, Any]:
        """As the emulator's control line answers."""
        devices = self.devices
        devices.advance(self.world.now_s)
        if cmd == "pulses":
            return {"pulses": devices.electrodes.pulses()}
        if cmd == "arm":
            assert devices.limb is not None
            devices.limb.move(request.pop("mode"), request, self.world.now_s)
        elif not (self.planted.dead_switch and request["name"] == "emergency_switch"):
            name, on = request.pop("name"), request.pop("on")
            if on:
                devices.faults.on(name, request)
            else:
                devices.faults.off(name)
        return {}

"""The rig on the bench: its own control, gate and limits play short trains of small pulses, and everything is heard.

A train is played only once a person has said on which output the dummy load is. After a fault that no step provoked,
nothing is played any more: what follows is not done.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.rig import devices
from stimrig.rig.check.ears import Ears, Heard
from stimrig.rig.check.person import Person
from stimrig.rig.check.surroundings import Surroundings
from stimrig.rig.config import RigConfig
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import RigError
from stimrig.rig.gate import Done
from stimrig.rig.limits import Limit
from stimrig.rig.machine import Machine
from stimrig.rig.messages import ChannelPlan, FinishedEvent, Profile, SegmentPlan, TestPlan
from stimrig.rig.signals import PulseStatus

CURRENT_MA, WIDTH_US, RATE_HZ = 16.0, 100.0, 40.0
"""The smallest current at which a P24 tells an open electrode is 15 mA; 1.6 µC a pulse is below the first train of a
calibration."""
MOST_TORQUE_NM = 2.0
"""Above the offset: on a dummy load nothing pulls, so torque would say that somebody is connected after all."""
EMULATED_TORQUE_NM = 30.0
REST_S, TAIL_S, AFTER_S = 0.4, 0.25, 1.1


class NotDone(Exception):
    """A step cannot be done: why."""


@dataclass(frozen=True)
class Train:
    """What became of a train: how it ended, its pulses, and all that the cell sent meanwhile."""

    finished: FinishedEvent
    pulses: list[Done]
    heard: Heard

    @property
    def acknowledged(self) -> list[Done]:
        return [one for one in self.pulses if one.status == PulseStatus.ACKNOWLEDGED]

    @property
    def sent(self) -> int:
        """Pulses that were written to the line."""
        return sum(math.isfinite(one.written_s) for one in self.pulses)


class Bench:
    """What the steps of a check share.

    Parameters
    ----------
    config
        The rig file's. The check plays in a folder of its own below `data_dir`, and never asks for a calibration: no
        person is connected. The rest between tests is the hard limit's, since a resistor does not tire.
    stand_still
        Lets the rig's thread stand still for so many seconds: a silent host.
    emulated
        Whether the devices are emulated, with a muscle that may pull.
    """

    def __init__(
        self, config: RigConfig, machine: Machine, person: Person, surroundings: Surroundings,
        stand_still: Callable[[float], None], emulated: bool, dummy_load_ohm: float = 1000.0, weight_nm: float = 5.0,
    ) -> None:  # fmt: skip
        self.given, self.surroundings, self.emulated = config, surroundings, emulated
        self.stand_still, self.ohm, self.weight_nm = stand_still, dummy_load_ohm, weight_nm
        self.ears, self.tasks, self.clock = Ears(machine), machine.tasks, machine.tasks.clock
        self.folder = config.data_dir / "check" / machine.new_id()[:8]
        limits = config.limits.model_copy(update={"rest_between_tests_s": None})
        own = {"data_dir": self.folder, "require_calibration": False, "require_check": False, "limits": limits}
        self.rig = Rig(config.model_copy(update=own), self.ears.as_machine(), lambda _: None)
        self.table: dict[str, Limit] = self.rig.table
        cell = config.load_cell
        self.cell: dict[str, Any] = cell.model_dump()
        self.sample_rate_hz = float(self.cell["sample_rate_hz"])
        self.modulus = int(devices.find("load_cell", cell.device).create(cell, machine).counter_modulus)
        self.loaded = False
        """Whether a person has said on which output the dummy load is, and it is the rig file's."""
        self.halted = ""
        """Why nothing is played any more."""
        self.offset_nm = 0.0
        self.quiet: Heard | None = None
        """What the cell sent while nobody touched it."""
        self.first: Train | None = None
        """The first whole train."""
        self.by = ""
        self._person, self._played = person, 0

    # -- the person

    async def answer(self, question: str, /, **words: Any) -> str:
        """What the person says. Raises NotDone: nothing."""
        answer = await self.tasks.work(lambda: self._person.ask(question, **words))
        if answer is None:
            raise NotDone(f"nobody answered the question {question!r}")
        return answer

    async def ask(self, question: str, /, **words: Any) -> str:
        """The same, where no is as good as nothing; nobody is asked where nothing would be done with it."""
        if self.halted:
            raise NotDone(self.halted)
        answer = await self.answer(question, **words)
        if answer.lower() in ("no", "skip", "n"):
            raise NotDone(f"the answer to the question {question!r} was no")
        return answer

    async def number(self, question: str, /, **words: Any) -> float:
        """The same as a number."""
        answer = await self.ask(question, **words)
        try:
            return float(answer.replace(",", "."))
        except ValueError:
            raise NotDone(f"{question}: {answer!r} is no number") from None

    async def tell(self, what: str) -> None:
        await self.tasks.work(lambda: self._person.tell(what))

    # -- listening

    async def listen(self, duration_s: float) -> Heard:
        """What the cell sends from now on."""
        place = self.ears.now()
        await self.tasks.sleep(duration_s)
        return self.ears.since(place)

    def need_cell(self) -> Heard:
        """The quiet stretch. Raises NotDone: the cell sent nothing that can be used."""
        if self.quiet is None or len(self.quiet.samples) < 10 or self.halted:
            raise NotDone(self.halted or "the load cell sends nothing")
        return self.quiet

    # -- playing

    @property
    def width_us(self) -> float:
        """Of every pulse of the check."""
        return min(WIDTH_US, self.table["pulse_width_us"].hi)

    @property
    def current_ma(self) -> float:
        return min(CURRENT_MA, self.table["current_ma"].hi)

    @property
    def outputs(self) -> dict[str, str]:
        """The outputs in use as the stimulator's case names them, by their channels; `""` of a rig without names."""
        settings = self.given.stimulator.model_dump()
        places = settings.get("channels") or [{"name": "", **settings}]
        named = "connector" in places[0]
        return {
            one.get("name", ""): f"{one['connector']}.{one['channel']}" if named else str(one["channel"])
            for one in places
        }

    async def play(self, on_s: float, channel: str = "", during: Callable[[], Any] | None = None) -> Train:
        """A train of so many seconds, on the first channel or a named one, and what became of it.

        `during`: a coroutine function that is run while it plays. Raises NotDone: no load is confirmed, or the rig is
        halted or refuses.
        """
        if self.halted or not self.loaded:
            raise NotDone(self.halted or "no dummy load is confirmed, so no pulse may flow")
        self._played += 1
        place, rig = self.ears.now(), self.rig
        try:
            await rig.start(self._plan(on_s, channel))
        except RigError as error:
            raise NotDone(f"the rig refuses: {error}") from None
        gate, playing = rig.pair.gate, rig.player.playing
        if during is not None:
            await during()
        if playing is not None:
            await self.tasks.wait(math.inf, playing.done)
        await self.tasks.sleep(AFTER_S)
        assert rig.finished is not None
        return Train(rig.finished, list(gate.done) if gate else [], self.ears.since(place))

    async def go_on(self, train: Train, provoked: bool) -> None:
        """After a train: re-arm what the step has provoked itself; after anything else nothing is played any more."""
        if train.finished.outcome == "completed":
            return
        if not provoked:
            self.halted = f"the rig has stopped: {train.finished.reason}"
            return
        try:
            await self.rig.rearm(self.by or "check", self.rig.latch)
        except RigError as error:
            self.halted = f"the rig could not be re-armed: {error}"

    async def until_pulses(self, count: int, longest_s: float = 5.0) -> bool:
        """Until the running train has sent so many, or has ended: whether it has, and still goes on."""
        player, end_s = self.rig.player, self.clock.now_s() + longest_s * self.clock.speed
        while player.run is not None and not player.run.halt.signal.is_set() and self.clock.now_s() < end_s:
            if player.run.t0_s is not None and player.run.sent >= count:
                return True
            await self.tasks.sleep(0.02)
        return False

    def _plan(self, on_s: float, channel: str) -> TestPlan:
        most_nm = EMULATED_TORQUE_NM if self.emulated else MOST_TORQUE_NM + abs(self.offset_nm)
        profile = Profile(
            current_ma=self.current_ma, max_pulse_width_us=self.width_us, max_torque_nm=most_nm,
        )  # fmt: skip
        on = {"max_pulse_width_us": self.width_us, "on_s": on_s, "off_s": 0.0, "repeats": 1}
        segments = [
            SegmentPlan(name="rest", sequence="rest", settings={"duration_s": REST_S}),
            SegmentPlan(name="steps", sequence="steps", settings=on),
            SegmentPlan(name="rest", sequence="rest", settings={"duration_s": TAIL_S}),
        ]
        name = channel or next(iter(self.outputs))
        channels = [ChannelPlan(name=name, profile=profile)] if name else None
        return TestPlan(
            test_id=f"check-{self._played}", participant="rig-check", kind="rig-check", profile=profile,
            segments=segments, pulse_rate_hz=min(RATE_HZ, self.table["pulse_rate_hz"].hi), channels=channels,
        )  # fmt: skip


def mean_nm(heard: Heard, last_s: float, rate_hz: float) -> float:
    """Mean torque of the last so many seconds, N·m; NaN where there is none."""
    values = heard.samples["torque_nm"][-max(1, int(last_s * rate_hz)) :]
    return float(np.mean(values)) if len(values) else math.nan

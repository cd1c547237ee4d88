"""Recordings of a rig of every kind, made in simulated time by requests to the rig's own code."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.settings import Settings
from stimrig.rig import messages as m
from stimrig.rig import requests as r
from stimrig.rig.control.rig import Rig
from tests.simulator.clinic import Clinic
from tests.simulator.disk import SimulatedDisk
from tests.simulator.host import Computer, Process
from tests.simulator.life import rig_file
from tests.simulator.wires import Wires
from tests.simulator.world import World

KEY = "a key of its own"
ROBOT = "robot,from_deg=60,to_deg=110,deg_s=60,pause_s=0.2"


class QuietRig:
    """A rig that nothing befalls, and somebody who asks it."""

    def __init__(self, arm: str | None = None, **more: Any) -> None:
        self.world = world = World(1)
        settings = Settings(rate_hz=200.0, noise_seed=1, angle_offset_deg=30.0, angle_direction=-1, **more)
        devices = make_devices(settings, arm, epoch_us=1_700_000_000_000_000)
        self.disk = SimulatedDisk(world)
        computer = Computer(world, 0.0, 1_764_000_000.0)
        process = Process(computer, self.disk, Wires(world, devices, 0.02, lambda *_: None))
        self.clinic = Clinic(world, devices.state)
        rig = Rig(rig_file(settings, devices, arm), process, lambda event: self.clinic.hear(process, event))
        self.clinic.meet(process, rig)
        process.post(lambda: process.tasks.spawn(rig.open(), "open"))
        process.listens = True
        self.until(lambda: self.clinic.state == "ready")

    def until(self, true: Callable[[], bool], within_s: float = 120.0) -> None:
        end_s = self.world.now_s + within_s
        while not true():
            assert self.world.now_s < end_s, self.world.trace[-5:]
            self.world.run(self.world.now_s + 0.05)

    def ask(self, request: Any) -> m.Reply:
        asked = self.clinic.ask(request)
        self.until(lambda: asked.reply is not None)
        assert asked.reply is not None
        return asked.reply

    def start(self, **plan: Any) -> None:
        profile = m.Profile(max_torque_nm=30.0)
        plan = {"test_id": "T1", "participant": "P1", "profile": profile, "protocol": "short"} | plan
        reply = self.ask(r.StartRequest(plan=m.TestPlan(**plan), key=KEY))
        assert reply.ok, reply
        self.until(lambda: self.clinic.state == "running")

    def ended(self) -> None:
        self.until(lambda: bool(self.clinic.finished))

    def files(self) -> dict[str, bytes]:
        return {path.name: bytes(file.data) for path, file in self.disk.files.items()}


def segment(name: str, sequence: str, **settings: Any) -> m.SegmentPlan:
    return m.SegmentPlan(name=name, sequence=sequence, settings=settings)


def plain(**more: Any) -> QuietRig:
    rig = QuietRig(**more)
    rig.start()
    rig.ended()
    return rig


def stopped() -> QuietRig:
    rig = QuietRig()
    rig.start()
    rig.world.run(rig.world.now_s + 12.0)
    rig.ask(r.StopRequest(reason="somebody pressed", by="nurse"))
    rig.ended()
    return rig


def adaptive() -> QuietRig:
    rig = QuietRig()
    rest, ramp = segment("rest", "rest", duration_s=1.0), segment("ramp", "ramp", up_s=2.0, down_s=2.0)
    bounds = m.AdaptivePlan(max_duration_s=40.0, max_torque_time_nms=200.0)
    rig.start(adaptive=bounds, segments=[rest, ramp, rest])
    laid = 40
    for name, sequence in (("prbs", "prbs"), ("validate", "multilevel")):
        more = [segment(name, sequence, **({"chips": 60} if sequence == "prbs" else {"duration_s": 6.0}))]
        reply = rig.ask(r.ExtendRequest(test_id="T1", key=KEY, after=laid, segments=more))
        assert reply.ok, reply
        laid = reply.body["laid"]
    rig.world.run(rig.world.now_s + 15.0)
    rig.ask(r.EnoughRequest(test_id="T1", by="clinician"))
    rig.ended()
    return rig


def joint(kind: str, arm: str) -> QuietRig:
    rig = QuietRig(arm)
    target = math.pi / 2 if kind == "held" else None
    angle = m.AnglePlan(range_rad=(0.2, 2.4), target_rad=target, still_s=None if target else 2.0)
    rest = {"segments": [segment("rest", "rest", duration_s=8.0)]}
    rig.start(kind=kind, angle=angle, **(rest if kind == "passive" else {}))
    rig.ended()
    return rig


def trial() -> QuietRig:
    rig = QuietRig()
    widths = [min(5.0 * k, 250.0) for k in range(120)] + [180.0] * 120
    rest = segment("rest", "rest", duration_s=1.0)
    rig.start(kind="sequence", segments=[rest, segment("trial", "widths", pulse_width_us=widths, jumps=True), rest])
    rig.ended()
    return rig


def calibration() -> QuietRig:
    rig = QuietRig()
    rig.ask(r.CalibrateStartRequest(calibration_id="C1", participant="P1", by="nurse", step_us=25.0))
    for marks, threshold in ((2, "sensory"), (3, "motor"), (3, "comfort")):
        for _ in range(marks):
            assert rig.ask(r.CalibrateStepRequest()).ok
            rig.until(lambda: rig.clinic.state == "calibrating")
        rig.ask(r.CalibrateMarkRequest(threshold=threshold))
    assert rig.ask(r.CalibrateFinishRequest(by="nurse", calibration_id="C1")).ok
    return rig


def broken_off() -> QuietRig:
    """Its process was killed in the middle: a journal is left."""
    rig = QuietRig()
    rig.start()
    rig.world.run(rig.world.now_s + 12.0)
    return rig


KINDS: dict[str, Callable[[], QuietRig]] = {
    "plain": plain, "counts_rehastim2": lambda: plain(cell="counts", stimulator="rehastim2"), "stopped": stopped,
    "adaptive": adaptive, "held": lambda: joint("held", "held"), "moving": lambda: joint("moving", ROBOT),
    "passive": lambda: joint("passive", ROBOT), "trial": trial, "calibration": calibration, "journal": broken_off,
}  # fmt: skip


@cache
def of_kind(kind: str) -> dict[str, bytes]:
    """The files of a rig's disk after a session of a kind."""
    return KINDS[kind]().files()

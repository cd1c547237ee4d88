"""Wiring check of a rig: `python -m stimrig.rig.check`, which `stimrig rig check` starts.

It asks the devices who they are, compares rates, zero and signs with the rig file, and sends one pulse into a dummy
load where a person says that one is connected. Progress and questions go to standard error, the report as one JSON
object to standard output. Exit 0: sound. 1: a fault, or something was not done. 2: bad input, or a rig is in use.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import os
import signal
import sys
import tempfile
from collections.abc import Awaitable, Callable
from concurrent.futures import wait
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import config as configuration
from stimrig.rig.adapters.files import Files
from stimrig.rig.adapters.machine import LocalMachine
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.config import RigConfig
from stimrig.rig.control.memory import LatchFile
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import ConfigError, RigError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import Profile, SegmentPlan, TestPlan
from stimrig.rig.signals import SAMPLE, PulseStatus

CURRENT_MA, WIDTH_US, RATE_HZ = 16.0, 100.0, 40.0
"""The smallest current at which a P24 reports an open electrode is 15 mA; 1.6 µC is below the first pulse train of a
calibration."""
MOST_TORQUE_NM = 2.0
"""Above rest, at which the test pulse's test is stopped: nothing pulls where only a dummy load is connected."""
LISTEN_S, REST_S, AFTER_PULSE_S = 3.0, 0.4, 1.5
MOST_LOST, MOST_RATE_OFF = 0.002, 0.02
EMULATED_SLACK = 10
"""By so much the two bounds are wider on an emulator, which shares its processors with other programs."""
MOST_OFFSET_NM, MOST_NOISE_NM = 2.0, 0.4
LEAST_PULL_NM, LEAST_BEND_RAD, MOST_LATENCY_MS = 0.5, 0.2, 4
CLOSED_WITHIN_S = 45.0
"""Real seconds for the stop, its evidence and the sealing of a test that was interrupted."""
INTERRUPTED = 130
ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL_S = 0.1  # a signal that another thread has taken is noticed after so long
TTY, NET = Path("/sys/class/tty"), Path("/sys/class/net")

Question = Callable[[str], bool]


class Step(NamedTuple):
    """Result of one step. `figure`: what was measured, or why it was not done; `fault`: one of `FAULTS`, or empty."""

    name: str
    outcome: Literal["passed", "failed", "not done"]
    figure: str
    bound: str = ""
    fault: str = ""


class Fault(Exception):
    """A step failed, by one of `FAULTS`."""


class NotDone(Exception):
    """A step was not done: why."""


FAULTS = {
    "port_missing": ("the port does not exist", "switch the device on; `ls -l /dev/stimrig` shows what is there"),
    "port_forbidden": ("this user may not use the port", "install deploy/udev/70-stimrig.rules, or join its group"),
    "latency_timer": ("the FTDI chip delays each answer", "install deploy/udev/70-stimrig.rules, and plug it in again"),
    "can_down": ("the CAN interface does not exist, or is down", "plug it in; systemctl restart stimrig-can@can0"),
    "stimulator": ("the stimulator cannot be opened, or does not answer as it should",
                   "switch it on, plug it in, stop other programs on its port, and compare stimulator.port (with slcan "
                   "load_cell.bus.channel, too) with what is connected"),
    "adapter": ("the CAN adapter cannot be opened", "plug it in, bring it up, and compare load_cell.bus"),
    "bit_rate": ("errors of the bus and no frame: the bit rate is wrong", "set BITRATE= in /etc/stimrig/can.env"),
    "wrong_dbc": ("frames come that do not fit the description", "give this cell's load_cell.dbc, message and signal"),
    "counter_stuck": ("readings come, but their counter stands still", "name the right signal in load_cell.counter"),
    "cell_silent": ("no frame of the cell comes", "check its supply, start_frames and the message of the DBC file"),
    "termination": ("errors of the bus: a terminating resistor is missing, or the cable is damaged",
                    "put 120 Ω at both ends of the bus, and look at the plugs"),
    "frames_lost": ("frames are lost although the bus reports no error", "connect the adapter without a hub"),
    "sample_rate": ("the cell samples at another rate than the rig file says", "correct load_cell.sample_rate_hz"),
    "no_number": ("the cell says that it is faulty, or gives no number", "read its display: overload, bridge, supply"),
    "noise": ("the torque is noisy: a loose shield, or mains hum", "fasten the shield, keep off mains cables"),
    "offset": ("the torque at rest is far from zero", "clear the lever and tare the cell"),
    "torque_sign": ("the torque has the wrong sign: the cell is upside down",
                    "turn the cell round, or change the sign of load_cell.scale_nm; flexion is positive"),
    "torque_unmoved": ("the torque does not follow the lever", "look at the mounting and load_cell.signal"),
    "angle_silent": ("the angle sensor gives no angle", "check its plug, its supply and angle_sensor.bus"),
    "angle_sign": ("the angle falls when the joint is bent", "change the sign of angle_sensor.direction"),
    "angle_unmoved": ("the angle does not follow the joint", "fasten the sensor's shaft"),
    "refused": ("the rig refused or ended the test of the pulse", "the message says what to look at"),
    "stop": ("the stimulator does not obey the stop", "connect nobody, and change its cable; else it needs its maker"),
    "open_circuit": ("the circuit is open: no load, a broken cable, or the emergency stop is pressed",
                     "put the load on both cables of this output, try another cable, release the emergency stop"),
    "unanswered": ("the pulse was not sent in time, or not acknowledged", "change the stimulator's cable; use no hub"),
    "torque_follows": ("torque follows the pulse: somebody is connected instead of the dummy load",
                       "take every electrode off the person, and put the dummy load on"),
    "sync": ("the sync line does not rise with the pulse", 'wire it to the cell, or write sync = "" in the rig file'),
}  # fmt: skip
"""Possible faults, each with its remedy."""
ENDINGS = {
    "end of stimulation is not confirmed": "stop", "electrode error": "open_circuit",
    "emergency switch": "open_circuit", "not acknowledged": "unanswered", "N·m is outside": "torque_follows",
}  # fmt: skip
"""Words in the reason why the test of a pulse ended, and the fault that they tell."""


class RigCheck:
    """The steps of a check on one rig.

    `question`: asks the person, in a thread of its own. `folder`: for the pulse's journal, never the rig's own folder.
    """

    def __init__(self, config: RigConfig, machine: Machine, question: Question, folder: Path, emulated: bool) -> None:
        self.config, self.machine, self.question = config, machine, question
        self.tasks = machine.tasks
        limits = config.limits.model_copy(update={"rest_between_tests_s": None})  # a resistor does not tire
        changes = {"data_dir": folder, "require_calibration": False, "limits": limits}
        self.rig = Rig(config.model_copy(update=changes), machine, lambda _: None)
        self.rest_nm, self.samples = 0.0, np.empty(0, SAMPLE)
        slack = EMULATED_SLACK if emulated else 1
        self.most_lost, self.most_rate_off = slack * MOST_LOST, slack * MOST_RATE_OFF

    async def run(self, report_step: Callable[[Step], None]) -> list[Step]:
        """Run all steps and close the rig. After a fault the steps that follow are not done.

        Raises ConfigError: the rig died in a test and waits for a person.
        """
        remembered, _ = await LatchFile(self.config.data_dir, self.machine).read()
        if remembered == "running":
            raise ConfigError(f"{self.config.data_dir}: the rig died in a test; start it, look, re-arm it, then check")
        looks = {"stimulator and adapter": self.check_devices, "load cell": self.check_frames}
        looks |= {"sample rate": self.check_rate, "zero": self.check_zero, "sign of the torque": self.check_sign}
        looks |= {} if self.config.angle_sensor is None else {"sign of the angle": self.check_angle}
        looks |= {"test pulse": self.check_pulse}
        steps, halted = list[Step](), ""
        try:
            for name, check in looks.items():
                step = Step(name, "not done", halted) if halted else await self._done(name, check)
                halted = halted or (f"{name}: {FAULTS[step.fault][0]}" if step.outcome == "failed" else "")
                steps.append(step)
                report_step(step)
        finally:
            if self.rig.status().state != "disconnected":
                await self.rig.close()
        return steps

    async def _done(self, name: str, check: Callable[[], Awaitable[None]]) -> Step:
        self.figure = self.bound = ""
        try:
            await check()
            return Step(name, "passed", self.figure, self.bound)
        except Fault as fault:
            return Step(name, "failed", self.figure, self.bound, str(fault))
        except NotDone as why:
            return Step(name, "not done", str(why))
        except RigError as error:
            return Step(name, "failed", str(error), "", "refused")

    def must(self, fault: str, holds: bool) -> None:
        """Raise Fault unless it holds; `figure` and `bound` say what was measured, and what it must be."""
        if not holds:
            raise Fault(fault)

    async def confirm(self, question: str) -> None:
        """Raise NotDone where the person does not say yes."""
        if not await self.tasks.work(self.question, question):
            raise NotDone("nobody said yes")

    async def listen(self, duration_s: float) -> NDArray[Any]:
        """Return the load cell's torques from now on. Raises Fault: none come."""
        self.receiver.live.clear()
        await self.tasks.sleep(duration_s)
        self.figure = self.rig.status().reason
        self.must("cell_silent", len(self.receiver.live) > 0)
        return np.concatenate(list(self.receiver.live))["torque_nm"]

    # -- devices, rates, zero

    async def check_devices(self) -> None:
        await self.rig.open()
        status, receiver = self.rig.status(), self.rig.pair.receiver
        self.figure, self.bound, stimulator = status.reason, "answers", status.stimulator
        if status.state != "ready" or receiver is None:
            raise Fault("stimulator" if status.reason.startswith("stimulator") else "adapter")
        self.receiver = receiver
        self.figure = " ".join(str(stimulator[key]) for key in ("device", "id", "firmware") if stimulator.get(key))

    async def check_frames(self) -> None:
        receiver, counts = self.receiver, self.receiver.counts
        await self.tasks.sleep(LISTEN_S)
        self.samples = np.concatenate([self.samples, *receiver.live])
        count, self.bound = len(self.samples), f"at most {100 * self.most_lost:g} % lost, no errors of the bus"
        self.figure = f"{count} samples, {counts.lost_samples} lost, {counts.error_frames} errors of the bus"
        if count < 10 or self.rig.status().state == "disconnected":
            self.must("bit_rate", counts.error_frames == 0)
            self.must("wrong_dbc", counts.malformed_frames == 0)
            self.must("counter_stuck", counts.duplicate_samples <= 10)
            raise Fault("cell_silent")
        self.must("termination", counts.error_frames <= max(1.0, self.most_lost * count))
        self.must("wrong_dbc", counts.malformed_frames <= self.most_lost * count)
        self.must("frames_lost", counts.lost_samples <= self.most_lost * count)

    async def check_rate(self) -> None:
        nominal_hz, rate_hz = self.receiver.nominal_rate_hz, measure_rate(self.samples, self.receiver.nominal_rate_hz)
        self.figure = f"{rate_hz:.1f} samples/s"
        self.bound = f"{nominal_hz:g} samples/s within {100 * self.most_rate_off:g} %"
        self.must("sample_rate", abs(rate_hz / nominal_hz - 1) <= self.most_rate_off)

    async def check_zero(self) -> None:
        torque_nm = await self.listen(1.0)
        offset_nm, noise_nm = float(np.median(torque_nm)), float(np.std(torque_nm))
        self.figure = f"{offset_nm:+.3f} N·m, noise {noise_nm:.3f} N·m"
        self.bound = f"within {MOST_OFFSET_NM:g} N·m, noise {MOST_NOISE_NM:g} N·m"
        self.must("no_number", bool(np.isfinite(torque_nm).all()))
        self.must("noise", noise_nm <= MOST_NOISE_NM)
        self.must("offset", abs(offset_nm) <= MOST_OFFSET_NM)
        self.rest_nm = offset_nm

    # -- signs, by a person's hand

    async def check_sign(self) -> None:
        await self.confirm("Pull the lever in the direction of flexion, and hold it. Is it held?")
        pulled_nm = float(np.median(await self.listen(1.0))) - self.rest_nm
        self.must_be_positive("torque", pulled_nm, LEAST_PULL_NM, "N·m")
        await self.confirm("Let go of the lever. Is it free?")

    async def check_angle(self) -> None:
        before = self.rig.joint.status()
        self.figure = before.problem
        self.must("angle_silent", before.angle_rad is not None and not before.problem)
        await self.confirm("Bend the joint by 30° or more in the direction of flexion, and hold it. Is it bent?")
        await self.tasks.sleep(1.0)
        angles_rad = before.angle_rad, self.rig.joint.status().angle_rad
        was_rad, is_rad = (math.nan if rad is None else rad for rad in angles_rad)
        self.must_be_positive("angle", is_rad - was_rad, LEAST_BEND_RAD, "rad")

    def must_be_positive(self, what: str, value: float, minimum: float, unit: str) -> None:
        """Raise Fault: the value is negative, or less than the minimum either way."""
        self.figure, self.bound = f"{value:+.2f} {unit}", f"at least +{minimum:g} {unit}"
        self.must(f"{what}_sign", not (value <= -minimum))
        self.must(f"{what}_unmoved", value >= minimum)

    # -- one pulse, through the rig's own gate and limits

    async def check_pulse(self) -> None:
        """Send one pulse and tell what became of it."""
        await self.confirm(
            "Connect nobody to the stimulator, and put a resistor of 500 Ω to 1 kΩ (2 W) on the cables alone. One "
            "pulse follows. Is nobody connected, and the resistor in place?"
        )
        rig, receiver = self.rig, self.receiver
        receiver.live.clear()
        await rig.start(self.plan())
        gate, playing = rig.pair.gate, rig.player.playing
        if playing is not None:
            await self.tasks.wait(math.inf, playing.done)
        finished = rig.player.finished
        assert gate is not None and finished is not None
        pulses = [pulse for pulse in gate.done if pulse.status != PulseStatus.REST]
        sync = np.concatenate([np.empty(0, "u1"), *(block["sync"] for block in receiver.live)])
        edges, reason = int(np.sum((sync[1:] == 1) & (sync[:-1] != 1))), finished.reason
        self.figure = f"one pulse: {reason or f'{edges} edges of the sync line'}"
        if finished.outcome != "completed":
            raise Fault(next((fault for words, fault in ENDINGS.items() if words in reason), "refused"))
        if [pulse.status for pulse in pulses] != [PulseStatus.ACKNOWLEDGED]:
            self.figure += f"; {', '.join(pulse.status.name for pulse in pulses)}"
            raise Fault("unanswered")
        self.bound = "1 edge"
        self.must("sync", edges == 1 or not self.config.load_cell.model_dump().get("sync"))
        after_ms = 1e3 * (pulses[0].acknowledged_s - pulses[0].written_s)
        self.figure += f", acknowledged after {after_ms:.1f} ms"
        self.bound = "acknowledged, without an error"

    def plan(self) -> TestPlan:
        """One pulse between two rests."""
        table, rate_hz = self.rig.table, min(RATE_HZ, self.rig.table["pulse_rate_hz"].hi)
        width_us, current_ma = min(WIDTH_US, table["pulse_width_us"].hi), min(CURRENT_MA, table["current_ma"].hi)
        most_nm = MOST_TORQUE_NM + abs(self.rest_nm)
        profile = Profile(current_ma=current_ma, max_pulse_width_us=width_us, max_torque_nm=most_nm)
        on = {"max_pulse_width_us": width_us, "on_s": 1 / rate_hz, "off_s": 0.0, "repeats": 1}
        segments = [
            SegmentPlan(name="rest", sequence="rest", settings={"duration_s": REST_S}),
            SegmentPlan(name="pulse", sequence="steps", settings=on),
            SegmentPlan(name="rest", sequence="rest", settings={"duration_s": AFTER_PULSE_S}),
        ]
        return TestPlan(
            test_id="check-pulse", participant="rig-check", kind="rig-check", profile=profile,
            segments=segments, pulse_rate_hz=rate_hz,
        )  # fmt: skip


def measure_rate(samples: NDArray[Any], nominal_hz: float) -> float:
    """Return the samples per second between the promptest sample of the first third and that of the last."""
    number = samples["counter"] if samples["counter"][0] >= 0 else np.arange(len(samples))
    lead_s, third = samples["host_time_s"] - number / nominal_hz, len(samples) // 3
    first, last = int(np.argmin(lead_s[:third])), len(samples) - third + int(np.argmin(lead_s[-third:]))
    return float((number[last] - number[first]) / (samples["host_time_s"][last] - samples["host_time_s"][first]))


def report(steps: list[Step], emulated: bool, devices: dict[str, Any]) -> dict[str, Any]:
    """Return what is printed: verdict, devices, and the steps, each fault with its cause and remedy."""
    outcomes = {step.outcome for step in steps}
    verdict = "faults" if "failed" in outcomes else "incomplete" if "not done" in outcomes else "sound"
    rows = [step._asdict() for step in steps]
    for row in rows:
        row["cause"], row["remedy"] = FAULTS.get(row["fault"], ("", ""))
    return {"format": "stimrig-rig-check", "format_version": 1, "verdict": verdict, "emulated": emulated,
            "devices": devices, "steps": rows}  # fmt: skip


def check_ports(config: RigConfig) -> Step:
    """Compare the rig file's ports and CAN interfaces with what the system shows; nothing is opened."""
    settings = {kind: device.model_dump() for kind, device in config.devices().items() if kind != "angle_sensor"}
    buses = {kind: device.get("bus") or {} for kind, device in settings.items()}
    slcan = {kind: bus["channel"].partition("@")[0] for kind, bus in buses.items() if bus.get("interface") == "slcan"}
    ports = {kind: device["port"] for kind, device in settings.items() if device.get("port")} | slcan
    links = [str(bus["channel"]) for bus in buses.values() if bus.get("interface") == "socketcan"]
    for kind, port in ports.items():
        if not Path(port).exists():
            return Step("ports", "failed", f"{kind}: {port}", "", "port_missing")
        if not os.access(port, os.R_OK | os.W_OK):
            return Step("ports", "failed", f"{kind}: {port}", "", "port_forbidden")
        with contextlib.suppress(OSError, ValueError):  # only an FTDI chip has one
            latency_ms = int((TTY / Path(port).resolve().name / "device/latency_timer").read_text())
            if latency_ms > MOST_LATENCY_MS:
                return Step("ports", "failed", f"{kind}: {latency_ms} ms", f"{MOST_LATENCY_MS} ms", "latency_timer")
    for link in links:
        flags = (NET / link / "flags").read_text() if (NET / link).exists() else "0"
        if not int(flags, 16) & 1:
            return Step("ports", "failed", link, "up", "can_down")
    return Step("ports", "passed", ", ".join([*map(str, ports.values()), *links]), "exist and may be used")


# -- the process


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m stimrig.rig.check", description="Check a rig's wiring.")
    configuration.add_arguments(parser)
    parser.add_argument("--data", type=Path, help="data folder; overrides the rig file")
    parser.add_argument("--no-questions", action="store_true", help="what needs a person is not done")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.CRITICAL)
    before = {number: signal.signal(number, _end) for number in ENDS}  # each stops the stimulator first
    try:
        config = configuration.chosen(options, data_dir=options.data, socket=Path("check.sock"))
        question = (lambda _: False) if options.no_questions else ask_at_terminal
        with exclusive(config.data_dir):
            result = check(config, question, emulated=options.config is None)
    except RigError as error:
        print(f"check: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("check: interrupted; the stimulator was stopped", file=sys.stderr)
        return INTERRUPTED
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    print(json.dumps(result, ensure_ascii=False, default=str))
    return 0 if result["verdict"] == "sound" else 1


def check(config: RigConfig, question: Question, emulated: bool) -> dict[str, Any]:
    """Check the rig of a rig file. After Ctrl-C the rig is stopped and closed before this ends."""
    print_step(ports := check_ports(config))
    if ports.outcome == "failed":
        return report([ports], emulated, {})
    machine = LocalMachine(MonotonicClock(config.clock_speed))
    with tempfile.TemporaryDirectory(prefix="stimrig-check-") as folder:
        checking = RigCheck(config, machine, question, Path(folder), emulated)
        try:
            running = machine.driver.submit(lambda: checking.run(print_step))
            while not wait([running], POLL_S).done:
                pass
            return report([ports, *running.result()], emulated, checking.rig.pair.identity)
        except KeyboardInterrupt:
            if not wait([machine.driver.submit(checking.rig.close)], CLOSED_WITHIN_S).done:
                raise RigError("interrupted, and no sign that the stimulator has stopped: switch it off") from None
            raise
        finally:
            machine.driver.end()


def exclusive(folder: Path) -> contextlib.AbstractContextManager[object]:
    """Lock the data folder as a rig does. Raises BusyError: a rig uses it; ConfigError: it is another user's."""
    if not folder.exists():  # no rig has used it yet
        return contextlib.nullcontext()
    if os.geteuid() == 0 and folder.stat().st_uid != 0:
        raise ConfigError(f"data_dir {folder}: another user's; check as that user (sudo -u USER stimrig rig check)")
    try:
        return Files().lock(folder)
    except OSError as error:
        raise ConfigError(f"data_dir {folder}: {error.strerror}; check as the user of the rig") from None


def ask_at_terminal(question: str) -> bool:
    """Ask on standard error, read standard input; anything but yes is no."""
    print(f"? {question} [yes/no]: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def print_step(step: Step) -> None:
    bound = f"  (must be: {step.bound})" if step.bound else ""
    print(f"{step.outcome:8} {step.name}: {step.figure}{bound}", file=sys.stderr, flush=True)


def _end(*_: object) -> None:
    """Let the first signal end the check; none that follows it cuts the stop short."""
    for number in ENDS:
        signal.signal(number, lambda *_: None)
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())

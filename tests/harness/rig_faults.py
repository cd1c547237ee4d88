"""Rigs with one planted fault each, and sound ones: what a check must tell, and must not."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from tests.harness.rig_checks import ADAPTER, STIMULATOR, Checked, Planted


def _lock(rig: Checked) -> None:
    rig.wires.locked = True


def _fill(rig: Checked) -> None:
    rig.disk.free = 1000


def _break(rig: Checked) -> None:
    rig.disk.failing = True


REHASTIM2 = {"stimulator": "rehastim2"}
WITHOUT_SYNC = {"cell": "counts"}
PLANTED = [
    Planted(
        "swapped lines", "lines_swapped", {"transport": "slcan"},
        rig_file={"stimulator.port": ADAPTER, "load_cell.bus": {"interface": "slcan", "channel": STIMULATOR}},
    ),
    Planted("wrong bit rate on CAN", "bit_rate", faults={"wrong_bit_rate": {}}),
    Planted("cell upside down", "cell_upside_down", faults={"torque_sign_flipped": {}}),
    Planted("termination missing", "termination", faults={"termination_missing": {}}),
    Planted("clock 1 % off", "clock_off", faults={"rate_off": {"percent": 1.0}}),
    Planted("wrong udev name", "port_missing", system={"exists": {STIMULATOR: False}}),
    Planted("stop line dead", "stop_dead", faults={"stop_lost": {}}),
    Planted("watchdog dead", "goes_on", faults={"goes_on": {}}),
    Planted("watchdog dead, no sync line", "goes_on", {**REHASTIM2, **WITHOUT_SYNC}, {"goes_on": {}}),
    Planted("weight reads double", "cell_scale", faults={"torque_scaled": {}}),
    Planted("wrong scale in the rig file", "cell_scale", rig_file={"load_cell.scale_nm": 0.5}),
    Planted("offset drifts", "drift", faults={"torque_drift": {}}),
    Planted("sync line not wired", "sync_unwired", faults={"sync_unwired": {}}),
    Planted("counter stuck", "counter_stuck", faults={"counter_stuck": {}}),
    Planted("frames dropped", "frames_dropped", faults={"frames_dropped": {"probability": 0.05}}),
    Planted("sample rate wrong", "sample_rate", rig_file={"load_cell.sample_rate_hz": 800.0}),
    Planted("latency timer 16 ms, by its answers", "answers_late", REHASTIM2, {"late_ack": {"delay_s": 0.016}}),
    Planted("latency timer 16 ms, by the system", "latency_timer", REHASTIM2, system={"latency_ms": {STIMULATOR: 16}}),
    Planted("noisy cell", "noise", faults={"torque_noisy": {}}),
    Planted("cell says that it is faulty", "cell_fault", faults={"cell_reports_fault": {}}),
    Planted("wrong channel in the rig file", "wrong_output", rig_file={"stimulator.channel": 3}),
    Planted("load not connected", "open_electrode", faults={"electrode_error": {"output": 1.0}}),
    Planted("load not connected, RehaStim 2", "open_electrode", REHASTIM2, {"electrode_error": {"output": 1.0}}),
    Planted("pulse width wrong at the device", "width_wrong", faults={"pulse_width_wrong": {}}),
    Planted("disk full", "disk_full", world=_fill),
    Planted("data folder not writable", "disk_not_writable", world=_break),
    Planted("wrong permissions of the port", "port_forbidden", system={"may_use": {STIMULATOR: False}}),
    Planted("angle sensor turned round", "angle_reversed", {"angle_direction": -1}, arm="held"),
    Planted("two rigs on one device", "port_in_use", system={"holder": {STIMULATOR: "process 77 (python)"}}),
    Planted("port locked by another user's program", "stimulator_locked", world=_lock),
    Planted("two channels swapped", "channels_swapped", channels=(2, 1)),
    Planted("two channels swapped, RehaStim 2", "channels_swapped", REHASTIM2, channels=(2, 1)),
    Planted("emergency stop not plugged in", "emergency_dead", dead_switch=True),
    Planted("stimulator off", "stimulator_silent", faults={"no_ack": {}}),
    Planted("cell not started", "cell_silent", {"cell": "canopen"}, rig_file={"load_cell.start_frames": []}),
    Planted("adapter's interface down", "can_down", system={"can_link": {"can0": {"up": False}}}),
    Planted("high voltage fails", "high_voltage", faults={"high_voltage_error": {}}),
    Planted("cell not tared", "offset", {"torque_offset_nm": 10.0}),
]  # fmt: skip
"""Those of the issue, and more."""


def sound_rigs(count: int, first_seed: int = 100) -> Iterator[tuple[Planted, int, float]]:
    """So many rigs without a fault, with a seed and the noise of the cell: device kinds × settings × patients."""
    kinds = itertools.cycle(itertools.product(("p24", "rehastim2"), ("plain", "canopen", "counts", "packed", "angle")))
    patients = itertools.cycle(("paper", "calcium", "paper"))
    for number, ((stimulator, cell), patient) in enumerate(itertools.islice(zip(kinds, patients, strict=False), count)):
        frames = {"cell": "plain", "samples_per_frame": 3} if cell == "packed" else {"cell": cell}
        settings = {
            "stimulator": stimulator,
            **({"cell": "plain"} if cell == "angle" else frames),
            "patient": patient,
            "rate_hz": (200.0, 400.0, 800.0)[number % 3],
            "clock_ppm": (-300.0, 120.0, 0.0, 300.0)[number % 4],
            "torque_offset_nm": (-0.6, 0.0, 1.1)[number % 3],
        }
        rig = Planted(
            f"{stimulator}, {cell}, {patient}", settings=settings, arm="held" if cell == "angle" else None,
            channels=(1, 2) if number % 5 == 0 and cell != "angle" else (),
        )  # fmt: skip
        yield rig, first_seed + number, (0.02, 0.05, 0.1, 0.15)[number % 4]

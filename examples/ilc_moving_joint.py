"""A learning controller while the joint is moved: a robot or a person repeats a movement, stimulation adds the torque.

    STIMRIG_TOKEN=… python examples/ilc_moving_joint.py --participant P017 --movement angles.csv --start "robot --go"

`angles.csv` has the angle at each pulse of a trial, in rad, one a line: the movement as it is meant to be. `--start` is
a command that starts it; it is run as soon as the trial's first pulse is seen to be due. The rig itself moves nothing.
The reference is the whole torque at the cell above the rest before the trial: a reach, and the passive torque that the
model foretells along the movement.

Trial k plays the widths for which the model, along the movement, gives reference - d, and learns

    d ← d + γ (y - ŷ - d)

y: what was measured; ŷ: what the model foretells for the widths that were sent along the angles that were measured. No
two movements are quite alike. A model with g(x, ẋ) and h(x, ẋ) (docs/moving-joint.md) foretells what the difference
does; a model of a joint at rest does not: to it, it is noise, which it plays back. `--model` names another version than
the approved one, to compare. See docs/controllers.md.
"""

from __future__ import annotations

import argparse
import io
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import h5py
import numpy as np
from ilc_controller import (
    AFTER_S,
    BEFORE_S,
    PULSE_RATE_HZ,
    HaltedError,
    Plant,
    Reference,
    Service,
    follow,
    measured,
    plan,
)

from stimrig import Client
from stimrig.errors import ServiceError

LEARNT = 0.8
"""γ: share of what the model does not explain that is believed at once."""
FIRST_SHARE, LEAST_SHARE = 1.0, 0.3


@dataclass
class MovingTrial:
    """One trial: what was played, what came, along which angles."""

    widths_us: np.ndarray
    torque_nm: np.ndarray
    angle_rad: np.ndarray
    error_percent: float


class MovingService(Service):
    """As `Service`, with a joint that is moved; `start_movement` is called when the trial's first pulse is due."""

    def __init__(self, client: Client, participant: str, start_movement: Callable[[], None]) -> None:
        super().__init__(client, participant)
        self.start_movement = start_movement

    def play_moving(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Play a trial: torque above rest, N·m, widths sent, µs, and angle, rad, in each pulse's period; (N,) each."""
        segments = [
            {"name": "rest", "sequence": "rest", "settings": {"duration_s": BEFORE_S}},
            {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": widths_us.tolist()}},
            {"name": "rest", "sequence": "rest", "settings": {"duration_s": AFTER_S}},
        ]
        started = False
        test: dict[str, Any] = {}
        for test in self.client.follow(self.start(segments, angle={})):  # it stops where the joint leaves its range
            if not started and test["state"] == "running" and (test.get("elapsed_s") or 0.0) >= BEFORE_S:
                started = True
                self._start_movement()
            if test["recording_id"]:
                if not started:
                    raise HaltedError("the trial was over before its movement was started")
                content = self.client.recording(test["recording_id"])
                return *measured(content, widths_us.size), angles(content, widths_us.size)
        raise HaltedError(f"the trial ended as {test['state']}: {test['reason']}")

    def _start_movement(self) -> None:
        try:
            self.start_movement()
        except OSError as error:
            self.client.stop()
            raise HaltedError(f"the movement did not start: {error}") from None

    def foretell(self, model: dict[str, Any], widths_us: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
        """Predict the torque along these angles, N·m above rest, shape (N,); a model without g and h ignores them."""
        along = angle_rad.tolist() if model.get("joint") else None
        return np.array(self.client.predict(model["model_id"], widths_us.tolist(), angle_rad=along))


def angles(recording: bytes, size: int) -> np.ndarray:
    """Mean angle in each pulse's period of a trial, rad, shape (N,)."""
    with h5py.File(io.BytesIO(recording)) as file:
        if "angle" not in file:
            raise HaltedError("the recording has no angle: this rig has no angle sensor")
        time_s, angle_rad = file["angle/time_s"][:], file["angle/angle_rad"][:]
    middle = BEFORE_S + (np.arange(size) + 0.5) / PULSE_RATE_HZ
    return np.interp(middle, time_s, angle_rad)


def learn_moving(
    service: Any, model: dict[str, Any], reference: Reference, movement_rad: np.ndarray, trials: int
) -> list[MovingTrial]:
    """Play and correct, trial after trial.

    Parameters
    ----------
    service : MovingService
        Or whatever has its `play_moving` and `foretell`.
    movement_rad : ndarray, shape (N,)
        The movement as it is meant to be; later it is taken to be as it was, on average.
    """
    plant = Plant(model, reference.torque_nm.size)
    demand, unexplained = plan(plant, reference), np.zeros(reference.torque_nm.size)
    expected_rad, done = movement_rad, []
    share = FIRST_SHARE
    for number in range(1, trials + 1):
        demand = follow(
            plant, demand, reference.torque_nm - unexplained, partial(service.foretell, model, angle_rad=expected_rad)
        )
        widths_us = plant.widths(demand)
        torque_nm, sent_us, angle_rad = service.play_moving(widths_us)
        error_nm = reference.torque_nm - torque_nm
        percent = 100 * float(np.sqrt(np.mean(error_nm**2))) / reference.rms_nm
        if done:
            share = max(LEAST_SHARE, share / 2) if percent > done[-1].error_percent else min(1.0, 1.5 * share)
        done.append(MovingTrial(widths_us, torque_nm, angle_rad, percent))
        print(f"  trial {number:2d}  {percent:6.2f} % of the reference's rms", file=sys.stderr)
        new_nm = torque_nm - service.foretell(model, sent_us, angle_rad) - unexplained
        unexplained = unexplained + LEARNT * share * new_nm
        expected_rad = np.mean([trial.angle_rad for trial in done], axis=0)
    return done


def movement_of(path: str) -> np.ndarray:
    """The angle at each pulse, rad, shape (N,), from a text file with one a line."""
    try:
        table = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        sys.exit(f"--movement {path}: {error}")
    if table.shape[1] != 1 or not np.all(np.abs(table) <= 2 * np.pi):
        sys.exit(f"--movement {path}: one angle a line, in rad")
    return table[:, 0]


def main() -> None:
    """Learn, and show how the error falls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--participant", required=True)
    parser.add_argument("--movement", required=True, help="file with the angle at each pulse, rad, one a line")
    parser.add_argument("--start", default="", help="command that starts the movement")
    parser.add_argument("--model", help="another version than the approved one; a controller's key opens none")
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--peak-nm", type=float, help="default: 40 %% of the largest torque the model is valid for")
    options = parser.parse_args()
    token = os.environ.get("STIMRIG_TOKEN") or sys.exit("set STIMRIG_TOKEN to a controller's key")
    command = shlex.split(options.start)
    if command and shutil.which(command[0]) is None:
        sys.exit(f"--start: there is no command {command[0]}")

    moves: list[subprocess.Popen[bytes]] = []

    def start_movement() -> None:
        if command:
            moves.append(subprocess.Popen(command))

    service = MovingService(Client(options.url, token), options.participant, start_movement)
    model = service.client.model_file(options.model) if options.model else service.fetch()
    movement_rad = movement_of(options.movement)
    peak_nm = options.peak_nm or 0.4 * float(model["recruitment"]["inverse"]["torque_nm"][-1])
    passive_nm = service.foretell(model, np.zeros(movement_rad.size), movement_rad)  # the stimulation need not undo it
    reference = Reference(np.resize(Reference.reach(peak_nm).torque_nm, movement_rad.size) + passive_nm)
    try:
        done = learn_moving(service, model, reference, movement_rad, options.trials)
    finally:  # nothing moves the arm on where the controller has halted
        for move in moves:
            move.terminate()
    kind = "with g and h" if model.get("joint") else "of a joint at rest"
    print(f"model {model['model_id']} {kind}, reference {reference.rms_nm:.2f} N·m rms; error in % of it")
    for number, trial in enumerate(done, start=1):
        print(f"{number:5d}  {trial.error_percent:8.2f}")


if __name__ == "__main__":
    try:
        main()
    except (HaltedError, ServiceError) as error:
        sys.exit(str(error))

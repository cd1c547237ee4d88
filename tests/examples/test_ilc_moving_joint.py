"""The learning controller of a joint that moves, on a simulated arm: with g and h it begins better; halts with the rig.

The arm and both models are made up here: no service and no identification between them.
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from stimrig import Client
from tests.examples.test_ilc_controller import MODEL, UNLIKE_THE_MODEL, felt, model_of, patient_of

pytestmark = pytest.mark.slow

PATH = Path(__file__).parents[2] / "examples" / "ilc_moving_joint.py"
SIZE, RATE_HZ = 400, 40.0
TRIALS = 4


@pytest.fixture(scope="module")
def ilc() -> Iterator[ModuleType]:
    """The example as it is started: the other one stands beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(PATH.parent))
        yield importlib.import_module("ilc_moving_joint")


def along(angle_rad: np.ndarray, widths_us: np.ndarray, muscle: Any, true: bool) -> np.ndarray:
    """T = g(x, ẋ) y + h(x, ẋ), above the rest before the trial; a model's g and h are a tenth beside the true ones."""
    velocity = np.gradient(angle_rad, 1 / RATE_HZ)
    bent, lost, spring, viscous = (0.5, 0.20, 1.5, 0.30) if true else (0.45, 0.18, 1.35, 0.33)
    g = 1 - bent * (angle_rad - 1.5) ** 2 - lost * velocity
    return g * felt(muscle, widths_us) - spring * (angle_rad - angle_rad[0]) - viscous * velocity


class Arm:
    """Stands where the service stands: the joint is moved out and back twice, never quite alike."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.angles: list[np.ndarray] = []

    def movement(self, late_s: float = 0.0, beside_rad: float = 0.0) -> np.ndarray:
        turn = np.clip(np.arange(SIZE) / RATE_HZ - late_s, 0.0, 10.0) * 2 * np.pi / 5.0
        return 1.0 + beside_rad + 0.4 * (1 - np.cos(turn))

    def play_moving(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert np.all(np.diff(np.r_[0, widths_us]) <= 50) and widths_us.shape == (SIZE,)
        late_s, beside_rad = self.rng.uniform(-0.05, 0.05), self.rng.uniform(-0.02, 0.02)
        self.angles.append(self.movement(late_s, beside_rad))
        torque_nm = along(self.angles[-1], widths_us, UNLIKE_THE_MODEL, true=True)
        return torque_nm + 0.01 * self.rng.standard_normal(SIZE), widths_us, self.angles[-1]

    def foretell(self, model: dict[str, Any], widths_us: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
        muscle = patient_of(*MODEL)
        return along(angle_rad, widths_us, muscle, true=False) if model.get("joint") else felt(muscle, widths_us)


def errors(ilc: ModuleType, arm: Arm, joint: dict[str, Any]) -> list[float]:
    """Of each trial, N·m rms: the whole torque is wanted, the passive one of the planned movement included."""
    shape = ilc.Reference.reach(2.5)
    reference = ilc.Reference(shape.torque_nm + along(arm.movement(), np.zeros(SIZE), UNLIKE_THE_MODEL, true=True))
    done = ilc.learn_moving(arm, model_of(*MODEL) | {"joint": joint}, reference, arm.movement(), TRIALS)
    assert len(done) == len(arm.angles) == TRIALS
    assert all(np.array_equal(trial.angle_rad, angle) for trial, angle in zip(done, arm.angles, strict=True))
    return [trial.error_percent * reference.rms_nm / 100 for trial in done]


def test_with_g_and_h_the_first_trial_is_far_better(ilc: ModuleType) -> None:
    with_them, without = (errors(ilc, Arm(), joint) for joint in ({"g": []}, {}))
    assert with_them[0] < 0.4 * without[0], (with_them, without)
    assert min(without[1:]) < 0.7 * without[0], "what repeats is learnt without them, too"
    assert np.mean(with_them[-2:]) < 1.1 * np.mean(without[-2:]), (with_them, without)
    assert np.mean(with_them[1:]) < with_them[0], "and there was something left to learn"


# ---- between controller and service ------------------------------------------------------------------------------


def recording(outcome: str = "completed", angle: bool = True) -> bytes:
    """A trial of `SIZE` pulses between two rests of a second; the angle grows by 0.1 rad/s, the torque is 0.3 N·m."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.attrs["outcome"], file.attrs["reason"] = outcome, "the joint left its range"
        time_s = np.arange(0, SIZE / RATE_HZ + 2, 0.005)
        file["torque/time_s"], file["torque/torque_nm"] = time_s, np.full(time_s.size, 0.3)
        file["pulses/sent_pulse_width_us"] = np.r_[np.zeros(40), np.full(SIZE, 90.0), np.zeros(40)]
        if angle:
            file["angle/time_s"], file["angle/angle_rad"] = time_s, 1.0 + 0.1 * time_s
    return content.getvalue()


class Answers:
    """A client whose trial runs, and ends."""

    def __init__(self, content: bytes, recording_id: str | None = "R1") -> None:
        self.content, self.recording_id, self.asked = content, recording_id, []

    def approved_model(self, _participant: str, _known: Any) -> Any:
        return SimpleNamespace(document=model_of(*MODEL), changed=True)

    def model_file(self, model_id: str) -> dict[str, Any]:
        return model_of(*MODEL) | {"model_id": model_id, "joint": {"g": []}}

    def start_test(self, participant: str, **more: Any) -> dict[str, Any]:
        assert (participant, more["kind"], more["angle"]) == ("P", "sequence", {}), "it stops with the angle"
        assert [part["sequence"] for part in more["segments"]] == ["rest", "widths", "rest"]
        return {"id": "T1"}

    def follow(self, test_id: str) -> Iterator[dict[str, Any]]:
        for state, elapsed_s, done in (("requested", None, False), ("running", 0.6, False), ("running", 1.1, False),
                                       ("running", 1.6, False), ("completed", 12.0, True)):  # fmt: skip
            ended = {"recording_id": self.recording_id if done else None, "reason": "stop pressed"}
            yield {"id": test_id, "state": state, "elapsed_s": elapsed_s, **ended}
            self.asked.append(elapsed_s)

    def recording(self, _recording_id: str) -> bytes:
        return self.content

    def predict(self, _model_id: str, widths: list[float], angle_rad: list[float] | None = None) -> list[float]:
        self.asked.append(angle_rad)
        return [0.0] * len(widths)


def service(ilc: ModuleType, client: Answers, begun: Callable[[], None] = lambda: None) -> Any:
    return ilc.MovingService(client, "P", begun)


def test_the_client_that_is_made_up_has_no_method_that_the_real_one_lacks() -> None:
    made_up = {name for name in vars(Answers) if not name.startswith("_")}
    assert [name for name in made_up if not hasattr(Client, name)] == []


def test_the_movement_is_started_once_when_the_first_pulse_is_due(ilc: ModuleType) -> None:
    client, begun = Answers(recording()), []
    torque_nm, sent_us, angle_rad = service(ilc, client, lambda: begun.append(list(client.asked))).play_moving(
        np.full(SIZE, 90.0)
    )
    assert begun == [[None, 0.6]], "not in the rest before it, and not again"
    assert sent_us.tolist() == [90.0] * SIZE and np.abs(torque_nm).max() < 1e-9
    np.testing.assert_allclose(angle_rad, 1.1 + 0.1 * (np.arange(SIZE) + 0.5) / RATE_HZ, atol=1e-6)


@pytest.mark.parametrize(
    ("client", "says"),
    [
        (Answers(recording(angle=False)), "no angle sensor"),
        (Answers(recording("fault")), "left its range"),
        (Answers(b"", recording_id=None), "completed: stop pressed"),
    ],
)
def test_a_trial_that_did_not_end_well_or_has_no_angle_halts_the_controller(
    ilc: ModuleType, client: Answers, says: str
) -> None:
    with pytest.raises(ilc.HaltedError, match=says):
        service(ilc, client).play_moving(np.full(SIZE, 90.0))


def test_a_movement_that_does_not_start_stops_the_trial(ilc: ModuleType) -> None:
    client, stops = Answers(recording()), []
    client.stop = lambda: stops.append("stop")
    with pytest.raises(ilc.HaltedError, match="did not start: robot"):
        service(ilc, client, Mock(side_effect=FileNotFoundError("robot"))).play_moving(np.full(SIZE, 90.0))
    assert stops == ["stop"]


@pytest.mark.parametrize(("text", "says"), [(None, "not found"), ("x\n", "could not convert"), ("1 2\n", "one angle"),
                                            ("90\n", "in rad"), ("nan\n", "in rad")])  # fmt: skip
def test_a_file_that_is_no_movement_is_told_in_a_line(ilc: ModuleType, tmp_path: Path, text: str | None, says: str):
    path = tmp_path / "angles.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(SystemExit, match=rf"--movement {path}: .*{says}"):
        ilc.movement_of(str(path))

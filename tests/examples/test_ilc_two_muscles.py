"""The learning controller of two muscles, on a simulated joint that is unlike its model; between it and the service.

Joint and model are made up here: no service and no identification between them.
"""

from __future__ import annotations

import ast
import importlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig import Client
from tests.examples.test_ilc_controller import model_of, patient_of

PATH = Path(__file__).parents[2] / "examples" / "ilc_two_muscles.py"
MODEL = {"biceps": (0.30, 0.65, 6.6, 148.0), "triceps": (0.22, 0.75, 4.8, 120.0)}
TRUE = {"biceps": (0.34, 0.68, 7.2, 152.0), "triceps": (0.24, 0.70, 4.4, 114.0)}
OFFSET_S, FINE_HZ = 0.0125, 2000
TRIALS = 6
CHOICES = ("none", "constant", "stiffness")


@pytest.fixture(scope="module")
def ilc() -> Iterator[ModuleType]:
    """The example as it is started: the other one stands beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(PATH.parent))
        yield importlib.import_module("ilc_two_muscles")


def document(sign: float = 1.0, turned: bool = False) -> dict[str, Any]:
    """A joint's model as far as the controller reads it; the triceps pulls the other way."""
    channels = []
    for name, own in (("biceps", sign), ("triceps", -sign)):
        model = model_of(*MODEL[name]) | {"pulse_rate_hz": 40.0}
        curve = model["recruitment"]
        curve["torque_nm"] = [own * one for one in curve["torque_nm"]]
        curve["inverse"]["torque_nm"] = [own * one for one in curve["inverse"]["torque_nm"]]
        channels.append({"name": name, "offset_s": OFFSET_S * (name == "triceps"), "model": model})
    return {"kind": "joint", "model_id": "M", "channels": channels[::-1] if turned else channels}


class Person:
    """Stands where the service stands: other muscles, cross-talk, and a joint that takes more with both at work."""

    def __init__(self, sign: float = 1.0, drops: bool = False, noise_nm: float = 0.01) -> None:
        self.sign, self.drops, self.noise_nm, self.rng = sign, drops, noise_nm, np.random.default_rng(3)
        self.own_nm: dict[str, np.ndarray] = {}

    def play_joint(self, widths_us: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        sent = {name: own.copy() for name, own in widths_us.items()}
        for own in sent.values():
            assert np.all(own == np.round(own)) and own.min() >= 0 and own.max() <= 300, "limits of each channel"
            assert np.diff(np.r_[0.0, own]).max() <= 50
            if self.drops:
                own[self.rng.integers(0, own.size, 3)] = 0.0
        size, each = next(iter(sent.values())).size, FINE_HZ // 40
        silent = np.zeros(size)
        felt = {name: patient_of(*TRUE[name]).torque(sent.get(name, silent), FINE_HZ) for name in TRUE}
        felt["triceps"] = felt["triceps"] + 0.1 * patient_of(*TRUE["triceps"]).torque(
            sent.get("biceps", silent), FINE_HZ
        )
        late = round(OFFSET_S * FINE_HZ)
        felt["triceps"] = np.r_[np.zeros(late), felt["triceps"]][: size * each]
        both = np.minimum(felt["biceps"] / 7.2, felt["triceps"] / 4.4)
        whole = self.sign * (felt["biceps"] - felt["triceps"]) * (1 - 0.3 * both)
        self.own_nm = {name: own.reshape(-1, each).mean(axis=1) for name, own in felt.items()}
        return whole.reshape(-1, each).mean(axis=1) + self.noise_nm * self.rng.standard_normal(size), sent


def learnt(ilc: ModuleType, person: Person, model: dict[str, Any], trials: int = TRIALS, **told: Any) -> list[Any]:
    return ilc.learn_joint(person, ilc.Joint(model, ilc.reachable(model), **told), trials)


def test_imports_nothing_of_ours_but_the_client_and_the_other_example() -> None:
    nodes = ast.walk(ast.parse(PATH.read_text("utf-8")))
    names = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    assert {"stimrig", "stimrig.errors", "ilc_controller"} <= names
    assert not {".".join(str(name).split(".")[:2]) for name in names} & {
        f"stimrig.{one}" for one in ("rig", "identify", "api")
    }


def test_the_reference_crosses_zero_without_a_jump(ilc: ModuleType) -> None:
    reference_nm = ilc.across_zero(3.0, 2.0)
    assert (reference_nm.min(), reference_nm.max()) == (-2.0, 3.0) and np.sum(np.diff(np.sign(reference_nm)) != 0) > 3
    assert np.abs(np.diff(reference_nm)).max() < 0.15 and reference_nm[0] == reference_nm[-1] == 0.0


@pytest.mark.parametrize("co_contraction", CHOICES)
def test_both_muscles_learn_a_torque_across_zero(ilc: ModuleType, co_contraction: str) -> None:
    done = learnt(ilc, Person(), document(), co_contraction=co_contraction)
    errors = [trial.error_percent for trial in done]
    assert errors[0] > 2.0, "else there was nothing to learn"
    assert min(errors[:4]) < 1.2 and errors[-1] < 1.0, errors


@pytest.mark.parametrize("only", ["biceps", "triceps"])
def test_one_muscle_alone_cannot(ilc: ModuleType, only: str) -> None:
    done = learnt(ilc, Person(), document(), 4, only=only)
    assert list(done[-1].widths_us) == [only] and done[-1].error_percent > 10.0


def test_constant_co_contraction_holds_both_and_none_does_not(ilc: ModuleType) -> None:
    for co_contraction, holds in (("constant", True), ("none", False)):
        person = Person()
        learnt(ilc, person, document(), 3, co_contraction=co_contraction, level=0.2)
        for name, own in person.own_nm.items():
            least = (own / TRUE[name][2])[60:-60].min()
            assert (least > 0.15) == holds and holds == (least > 0.05), (name, least)


def test_corrections_do_not_wind_both_muscles_up(ilc: ModuleType) -> None:
    """With noise and twelve trials the muscle that is not needed stays silent."""
    model, person = document(), Person(noise_nm=0.05)
    learnt(ilc, person, model, 12)
    reference_nm = ilc.reachable(model)
    assert person.own_nm["biceps"][reference_nm < -1.0].max() < 0.4
    steady = np.flatnonzero(reference_nm > 0.99 * reference_nm.max())[10:]
    assert person.own_nm["triceps"][steady].max() < 0.55, "a tenth of what the biceps is sent reaches it"


def test_order_of_channels_and_sign_of_the_record_change_nothing(ilc: ModuleType) -> None:
    first = learnt(ilc, Person(noise_nm=0.0), document(), 3)
    turned = learnt(ilc, Person(noise_nm=0.0), document(turned=True), 3)
    reference_nm = -ilc.reachable(document())
    down = ilc.learn_joint(Person(-1.0, noise_nm=0.0), ilc.Joint(document(-1.0), reference_nm), 3)
    for name in TRUE:
        for other in (turned, down):
            np.testing.assert_allclose(other[-1].widths_us[name], first[-1].widths_us[name], atol=1.0)


def test_a_dropped_pulse_is_not_learnt(ilc: ModuleType) -> None:
    done = learnt(ilc, Person(drops=True), document())
    assert all(trial.lost_pulses > 0 for trial in done) and done[-1].error_percent < 2.5


def test_the_slope_is_that_of_the_torque(ilc: ModuleType) -> None:
    reference_nm = ilc.reachable(document())[:160]
    joint = ilc.Joint(document(), reference_nm, "stiffness")
    rng = np.random.default_rng(0)
    demand, step = 0.7 * reference_nm, 1e-6 * rng.standard_normal(160)
    moved = joint.torque(joint.demands(demand + step)) - joint.torque(joint.demands(demand - step))
    np.testing.assert_allclose(joint.slope(demand) @ step, moved / 2, atol=1e-9)


def test_two_muscles_that_pull_alike_are_refused(ilc: ModuleType) -> None:
    model = document()
    model["channels"][1] = model["channels"][0] | {"name": "triceps"}
    with pytest.raises(ValueError, match="one muscle that raises the torque and one that lowers it"):
        ilc.Joint(model, np.zeros(40))


# ---- between controller and service ------------------------------------------------------------------------------


def recording(size: int, channels: tuple[str, ...] = ("biceps", "triceps")) -> bytes:
    """A trial of `size` periods between two rests of a second: 90 µs and 60 µs, one pulse of each lost; 0.3 N·m."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.attrs["outcome"], file.attrs["reason"], file.attrs["format_version"] = "completed", "", 2
        file.attrs["channels"] = json.dumps([{"name": name} for name in channels])
        time_s = np.arange(0, size / 40.0 + 2, 0.005)
        file["torque/time_s"] = time_s
        file["torque/torque_nm"] = np.where(time_s < 1.0, 0.0, 0.3)
        rows = np.stack([np.r_[np.zeros(40), np.full(size, width), np.zeros(40)] for width in (90.0, 60.0)])
        rows[0, 45], rows[1, 50] = np.nan, np.nan
        file["pulses/sent_pulse_width_us"] = rows.T.ravel()
        file["pulses/channel"] = np.tile(np.arange(2, dtype=np.uint8), rows.shape[1])
    return content.getvalue()


class Answers:
    """A client whose trial runs, and ends."""

    def __init__(self, content: bytes, recording_id: str | None = "R1", model: dict[str, Any] | None = None) -> None:
        self.content, self.recording_id, self.segments = content, recording_id, []
        self.model = document() if model is None else model

    def approved_model(self, _participant: str, _known: Any) -> Any:
        return SimpleNamespace(document=self.model, changed=True)

    def start_test(self, participant: str, **more: Any) -> dict[str, Any]:
        assert (participant, more["kind"]) == ("P", "sequence")
        self.segments = more["segments"]
        return {"id": "T1"}

    def follow(self, test_id: str) -> Iterator[dict[str, Any]]:
        yield {"id": test_id, "state": "running", "recording_id": None, "reason": ""}
        yield {"id": test_id, "state": "stopped", "recording_id": self.recording_id, "reason": "stop pressed"}

    def recording(self, _recording_id: str) -> bytes:
        return self.content


def test_the_client_that_is_made_up_has_no_method_that_the_real_one_lacks() -> None:
    made_up = {name for name in vars(Answers) if not name.startswith("_")}
    assert [name for name in made_up if not hasattr(Client, name)] == []


def test_a_trial_names_what_each_channel_plays_and_reads_what_each_was_sent(ilc: ModuleType) -> None:
    client, widths = Answers(recording(20)), {"triceps": np.full(20, 60.0), "biceps": np.full(20, 90.0)}
    torque_nm, sent = ilc.JointService(client, "P").play_joint(widths)
    assert [part["sequence"] for part in client.segments] == ["rest", "widths", "rest"]
    played = client.segments[1]["channels"]
    assert played["biceps"]["settings"]["pulse_width_us"] == [90.0] * 20
    assert played["triceps"]["settings"]["pulse_width_us"] == [60.0] * 20
    assert torque_nm.shape == (20,) and torque_nm[5] == pytest.approx(0.3)
    assert [int(np.sum(sent[name] == 0.0)) for name in widths] == [1, 1]
    assert sent["biceps"].max() == 90.0 and sent["triceps"].max() == 60.0 and sent["biceps"][5] == 0.0


@pytest.mark.parametrize(
    ("client", "says"),
    [
        (Answers(b"", recording_id=None), "stopped: stop pressed"),
        (Answers(recording(20, ("biceps", "other"))), "no channel triceps"),
    ],
)
def test_a_trial_that_did_not_end_well_halts_the_controller(ilc: ModuleType, client: Answers, says: str) -> None:
    with pytest.raises(ilc.HaltedError, match=says):
        ilc.JointService(client, "P").play_joint({name: np.full(20, 80.0) for name in TRUE})


@pytest.mark.parametrize(
    ("more", "says"),
    [([], "of one muscle"), (["--only", "calf"], "no such channel")],
)
def test_what_it_cannot_work_with_is_told_in_a_line(
    ilc: ModuleType, monkeypatch: pytest.MonkeyPatch, more: list[str], says: str
) -> None:
    client = Answers(b"", model=document() if more else model_of(*MODEL["biceps"]))
    monkeypatch.setattr(ilc, "Client", lambda *_: client)
    monkeypatch.setenv("STIMRIG_TOKEN", "a token")
    monkeypatch.setattr("sys.argv", ["ilc", "--participant", "P", *more])
    with pytest.raises(SystemExit, match=says):
        ilc.main()


def test_it_tells_the_error_of_each_trial(
    ilc: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    client = Answers(recording(ilc.reachable(document()).size))
    monkeypatch.setattr(ilc, "Client", lambda *_: client)
    monkeypatch.setenv("STIMRIG_TOKEN", "a token")
    monkeypatch.setattr("sys.argv", ["ilc", "--participant", "P", "--trials", "2", "--co-contraction", "stiffness"])
    ilc.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("model M, from -1.92 to 3.30") and len(lines) == 3

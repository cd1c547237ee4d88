"""A learning controller over two muscles that pull against each other: a torque that crosses zero.

    STIMRIG_TOKEN=… python examples/ilc_two_muscles.py --participant P017 --co-contraction stiffness

One muscle only pulls. With an antagonist on a second channel the torque may have either sign. The controller learns one
signed demand w for the joint. Above zero it goes to the muscle that raises the torque, below to the one that lowers it,
with a smooth change between them; co-contraction is a floor c under both:

    d₁ = c₁ + p(v),  d₂ = c₂ + p(-v),  v = w - (c₁ - c₂);  p(v): v above 0, else 0, rounded off;  y = G₁ d₁ - G₂ d₂

So correcting w never winds both muscles up against each other. The law is norm-optimal (Amann, Owens and Rogers 1996)
along the slope of y: J = G₁ diag(p'(v)) + G₂ diag(p'(-v)), w ← w + (JᵀJ + λI)⁻¹ Jᵀ e. What the model says of cross-talk
and of co-contraction is not used: it repeats, and is learnt.

Of this software it uses `stimrig.Client` alone. `--only biceps` learns with one muscle, to compare. See
docs/controllers.md.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import sys
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from ilc_controller import (
    AFTER_S,
    BEFORE_S,
    GROWTH,
    LAMBDA,
    LEAST_SHARE,
    PLAN_STEPS,
    PULSE_RATE_HZ,
    HaltedError,
    Plant,
    Service,
    measured,
)

from stimrig import Client
from stimrig.errors import ServiceError

CO_CONTRACTIONS = ("none", "constant", "stiffness")
LEVEL = 0.1
"""Share of each muscle's largest torque that co-contraction keeps."""
NEAR_ZERO = 0.15
"""`stiffness` keeps it where the reference is below this share of the weaker muscle's largest torque."""
SMOOTH = 0.02
"""Share of the weaker muscle's largest torque in which one muscle hands over to the other."""
FADE_S = 0.5
DIVERGED = 1.5
"""Two trials in a row that are worse, and worse by this factor than the best: what was learnt since leads nowhere, as
where an electrode reaches the other muscle more the more it is sent. The controller goes back to the best trial."""


@dataclass
class JointTrial:
    """One trial: what was played on each channel, what came."""

    widths_us: dict[str, np.ndarray]
    torque_nm: np.ndarray
    error_percent: float  # rms, of the reference's range
    lost_pulses: int


class Joint:
    """Both muscles of a joint's model, from one signed demand to the torque; arrays of shape (N,).

    Parameters
    ----------
    document : dict
        The joint's model: `channels`, each with its own MODEL.json.
    reference_nm : ndarray, shape (N,)
        The torque to follow, by which co-contraction is laid.
    co_contraction : str
        One of `CO_CONTRACTIONS`.
    only : str, optional
        The one channel that is used.
    """

    def __init__(
        self,
        document: dict[str, Any],
        reference_nm: np.ndarray,
        co_contraction: str = "none",
        level: float = LEVEL,
        only: str | None = None,
    ) -> None:
        told = [one for one in document["channels"] if only in (None, one["name"])]
        self.names, self.reference_nm = [one["name"] for one in told], reference_nm
        self.signs = np.array([sign_of(one["model"]) for one in told])
        if only is None and sorted(self.signs) != [-1.0, 1.0]:
            raise ValueError("this controller needs one muscle that raises the torque and one that lowers it")
        self.plants = [Plant(pulling(one), reference_nm.size) for one in told]
        self.largest_nm = np.array([plant.largest_nm for plant in self.plants])
        self.smooth_nm = SMOOTH * self.largest_nm.min()
        self.floors_nm = level * self.largest_nm[:, None] * self._kept(co_contraction)
        free_nm = self.largest_nm - self.floors_nm.max(axis=1)
        self.least_nm, self.most_nm = (max(0.0, *(sign * self.signs * free_nm)) * sign for sign in (-1.0, 1.0))

    def _kept(self, co_contraction: str) -> np.ndarray:
        """The share of the floor that is kept at each pulse: none at both ends of a trial."""
        size, fade = self.reference_nm.size, FADE_S * PULSE_RATE_HZ
        ends = np.clip(np.minimum(np.arange(size), np.arange(size)[::-1]) / fade, 0.0, 1.0)
        near = np.clip(2.0 - np.abs(self.reference_nm) / (NEAR_ZERO * self.largest_nm.min()), 0.0, 1.0)
        return ends * {"none": np.zeros(size), "constant": np.ones(size), "stiffness": near}[co_contraction]

    def demands(self, demand_nm: np.ndarray) -> np.ndarray:
        """Each muscle's part, N·m in its direction of pull, shape (C, N)."""
        own, d = self._own(demand_nm), self.smooth_nm
        part = np.where(np.abs(own) < d, (own + d) ** 2 / (4 * d), np.maximum(own, 0.0))
        return np.minimum(self.floors_nm + part, self.largest_nm[:, None])

    def slope(self, demand_nm: np.ndarray) -> np.ndarray:
        """J: how the torque changes with the demand, shape (N, N)."""
        shares = np.clip((self._own(demand_nm) / self.smooth_nm + 1.0) / 2.0, 0.0, 1.0)
        return sum(plant.G * share for plant, share in zip(self.plants, shares, strict=True))

    def _own(self, demand_nm: np.ndarray) -> np.ndarray:
        return self.signs[:, None] * (demand_nm - self.signs @ self.floors_nm)

    def torque(self, active_nm: np.ndarray) -> np.ndarray:
        """What these torques before G make of the joint's, N·m."""
        told = zip(self.signs, self.plants, active_nm, strict=True)
        return sum(sign * (plant.G @ own) for sign, plant, own in told)

    def corrected(self, demand_nm: np.ndarray, error_nm: np.ndarray, share: float = 1.0) -> np.ndarray:
        """w ← w + (JᵀJ + λI)⁻¹ Jᵀ e, within what the muscles can give beyond the floors."""
        J, middle = self.slope(demand_nm), self.signs @ self.floors_nm
        step = np.linalg.solve(J.T @ J + LAMBDA * np.eye(len(J)), J.T @ error_nm)
        return middle + np.clip(demand_nm + share * step - middle, self.least_nm, self.most_nm)

    def planned(self) -> np.ndarray:
        """The demand with which the models' torques add up to the reference."""
        demand = np.zeros(self.reference_nm.size)
        for _ in range(PLAN_STEPS):
            demand = self.corrected(demand, self.reference_nm - self.torque(self.demands(demand)))
        return demand

    def widths(self, demand_nm: np.ndarray) -> dict[str, np.ndarray]:
        """By channel, whole µs, rises limited."""
        told = zip(self.names, self.plants, self.demands(demand_nm), strict=True)
        return {name: plant.widths(own) for name, plant, own in told}

    def levels(self, widths_us: dict[str, np.ndarray]) -> np.ndarray:
        """f of each muscle, N·m in its direction of pull, shape (C, N)."""
        return np.stack([plant.level(widths_us[name]) for name, plant in zip(self.names, self.plants, strict=True)])


def sign_of(model: dict[str, Any]) -> float:
    """1 if the muscle raises the torque, else -1."""
    return 1.0 if model["recruitment"]["inverse"]["torque_nm"][-1] > 0.0 else -1.0


def pulling(channel: dict[str, Any]) -> dict[str, Any]:
    """A channel's MODEL.json as that of a muscle that raises the torque, its delay with the channel's offset."""
    model, sign = channel["model"], sign_of(channel["model"])
    curve, linear = model["recruitment"], model["linear"]
    inverse = curve["inverse"] | {"torque_nm": [sign * one for one in curve["inverse"]["torque_nm"]]}
    turned = curve | {"torque_nm": [sign * one for one in curve["torque_nm"]], "inverse": inverse}
    late = linear["delay_samples"] + round(channel["offset_s"] * model["sample_rate_hz"])
    return model | {"recruitment": turned, "linear": linear | {"delay_samples": late}}


def across_zero(up_nm: float, down_nm: float) -> np.ndarray:
    """Thirteen seconds: a slow sine of 40 % of both, then minimum-jerk moves to -down, to up, and back to 0."""
    parts = [np.zeros(8)]
    turn = np.sin(2 * np.pi * np.arange(1, round(5 * PULSE_RATE_HZ) + 1) / (5 * PULSE_RATE_HZ))
    parts.append(0.4 * np.where(turn > 0, up_nm, down_nm) * turn * np.abs(turn) ** 0.5)
    level = 0.0
    for target, move_s in ((-down_nm, 1.8), (up_nm, 2.6), (0.0, 1.8)):
        s = np.arange(1, round(move_s * PULSE_RATE_HZ) + 1) / (move_s * PULSE_RATE_HZ)
        parts += [level + (target - level) * (10 * s**3 - 15 * s**4 + 6 * s**5)]
        parts += [np.full(round(0.5 * PULSE_RATE_HZ), target)]
        level = target
    return np.concatenate(parts)


def reachable(document: dict[str, Any], up: float = 0.5, down: float = 0.4) -> np.ndarray:
    """`across_zero` for these shares of what the muscles can give."""
    ends = [one["model"]["recruitment"]["inverse"]["torque_nm"][-1] for one in document["channels"]]
    return across_zero(up * max(ends), -down * min(ends))


class JointService(Service):
    """As `Service`, for trials of several channels."""

    def play_joint(self, widths_us: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Play a trial; torque above rest in each pulse's period, N·m, and the widths sent by channel, µs."""
        played = {name: {"sequence": "widths", "settings": {"pulse_width_us": own.tolist()}}
                  for name, own in widths_us.items()}  # fmt: skip
        rests = [
            {"name": "rest", "sequence": "rest", "settings": {"duration_s": rest_s}} for rest_s in (BEFORE_S, AFTER_S)
        ]
        trial = {"name": "trial", **next(iter(played.values())), "channels": played}
        for test in self.client.follow(self.start([rests[0], trial, rests[1]])):
            if test["recording_id"]:
                content = self.client.recording(test["recording_id"])
                size = next(iter(widths_us.values())).size
                sent = sent_of(content, size)
                missing = set(widths_us) - set(sent)
                if missing:
                    raise HaltedError(f"the recording has no channel {', '.join(sorted(missing))}")
                return measured(content, size)[0], {name: sent[name] for name in widths_us}
        raise HaltedError(f"the trial ended as {test['state']}: {test['reason']}")


def sent_of(recording: bytes, size: int) -> dict[str, np.ndarray]:
    """The widths that were really sent, by channel, µs, shape (N,); 0 for a pulse that was dropped."""
    first = round(BEFORE_S * PULSE_RATE_HZ)
    with h5py.File(io.BytesIO(recording)) as file:
        names = [one["name"] for one in json.loads(file.attrs.get("channels", "[]"))]
        of, widths = file["pulses/channel"][:] if names else np.zeros(0), file["pulses/sent_pulse_width_us"][:]
    return {name: np.nan_to_num(widths[of == place])[first : first + size] for place, name in enumerate(names)}


def learn_joint(service: Any, joint: Joint, trials: int) -> list[JointTrial]:
    """Play and correct, trial after trial; `service`: a `JointService`, or whatever has its `play_joint`."""
    reference_nm, demand = joint.reference_nm, joint.planned()
    service.wanted_nm = reference_nm
    done: list[JointTrial] = []
    share, worse, best = 1.0, 0, (np.inf, demand, np.zeros(demand.size))
    for number in range(1, trials + 1):
        widths_us = joint.widths(demand)
        torque_nm, sent_us = service.play_joint(widths_us)
        error_nm = reference_nm - torque_nm
        percent = 100 * float(np.sqrt(np.mean(error_nm**2)) / np.ptp(reference_nm))
        if done:
            worse = worse + 1 if percent > done[-1].error_percent else 0
            share = max(LEAST_SHARE, share / 2) if worse else min(1.0, GROWTH * share)
        lost = sum(int(np.sum(sent_us[name] != own)) for name, own in widths_us.items())
        done.append(JointTrial(widths_us, torque_nm, percent, lost))
        print(f"  trial {number:2d}  {percent:6.2f} % of the reference's range, {lost} pulses lost", file=sys.stderr)
        not_sent_nm = joint.torque(joint.levels(widths_us) - joint.levels(sent_us))  # no reason to learn from it
        if percent < best[0]:
            best = percent, demand, error_nm - not_sent_nm
        back = worse > 1 and percent > DIVERGED * best[0]
        _, demand, learnt_nm = best if back else (percent, demand, error_nm - not_sent_nm)
        best = (np.inf, *best[1:]) if back else best  # it is measured anew: the muscle may have changed
        demand = joint.corrected(demand, learnt_nm, share)
    return done


def main() -> None:
    """Learn, and show how the error falls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--participant", required=True)
    parser.add_argument("--co-contraction", choices=CO_CONTRACTIONS, default="none")
    parser.add_argument(
        "--level", type=float, default=LEVEL, help="share of each muscle's largest torque that it keeps"
    )
    parser.add_argument("--only", help="channel of the one muscle to learn with")
    parser.add_argument("--trials", type=int, default=10)
    options = parser.parse_args()
    token = os.environ.get("STIMRIG_TOKEN") or sys.exit("set STIMRIG_TOKEN to a controller's key")
    service = JointService(Client(options.url, token), options.participant)
    model = service.fetch()
    if model.get("kind") != "joint":
        sys.exit("the approved model is of one muscle: run a test of two channels")
    if not abs(model["channels"][0]["model"]["pulse_rate_hz"] / PULSE_RATE_HZ - 1) < 1e-3:
        sys.exit(f"this controller plays {PULSE_RATE_HZ:g} pulses a second, the model is of another rate")
    if options.only not in (None, *(one["name"] for one in model["channels"])):
        sys.exit(f"--only {options.only}: the model has no such channel")
    reference_nm = reachable(model)
    joint = Joint(model, reference_nm, options.co_contraction, options.level, options.only)
    done = learn_joint(service, joint, options.trials)
    print(
        f"model {model['model_id']}, from {reference_nm.min():.2f} to {reference_nm.max():.2f} N·m; error in % of that"
    )
    for number, trial in enumerate(done, start=1):
        print(f"{number:5d}  {trial.error_percent:8.2f}")


if __name__ == "__main__":
    try:
        main()
    except (HaltedError, ServiceError, ValueError) as error:
        sys.exit(str(error))

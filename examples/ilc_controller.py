"""An iterative learning controller: fetch the approved model, plan, play, measure, learn.

    STIMRIG_TOKEN=… python examples/ilc_controller.py --url http://127.0.0.1:8000 --participant P017 --svg ilc.svg

It fetches the approved MODEL.json, plans the pulse widths of a trial for a reference torque by inverting the
recruitment curve f and the linear dynamics G, plays them through `POST /v1/tests` (kind `sequence`: the rig's gate
checks every pulse), reads the torque back from the recording, and corrects the next trial. Of this software it uses
`stimrig.Client` alone, which speaks HTTP; docs/api.md tells the routes to those who write one in another language.

Two laws, both on the demanded torque w before f⁻¹, e the tracking error of a trial:

- norm-optimal (Amann, Owens and Rogers 1996): w ← w + (GᵀG + λI)⁻¹ Gᵀ e
- phase lead (Freeman 2009, FES of stroke patients): w(t) ← Q[w(t) + γ e(t + τ)], with lead τ and the cut of the
  zero-phase filter Q chosen from G

If the model carries effects, no equation of theirs is needed here: the service predicts a trial
(`POST /v1/models/{id}/prediction`), and the plan is corrected on the prediction until it follows the reference; after
a trial, until the prediction has moved by the error.

With `--tracked` the model is fetched again after each trial: the approved one, moved to where gain, threshold and speed
are expected in the next trial (`tracking.coming`; `tracking.now` is what is known of the trial just played). The trial
was planned with a model that was a little wrong: what it demanded of the muscle is w + f_now(u) - f_planned(u). The
torque that the model now does not explain, d, is learnt as above, without the stretches in which the muscle did
something of its own (`tracking.disturbed_s`). What the model foretells carries no noise and is corrected in full:
the next trial is planned for reference - d. Without a change of the model this is the law above.
"""

from __future__ import annotations

import argparse
import copy
import io
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import h5py
import numpy as np

from stimrig import Client
from stimrig.errors import Conflict, Invalid, ServiceError

PULSE_RATE_HZ = 40.0
BEFORE_S, AFTER_S = 1.0, 1.0
RISE_US = 50.0
"""The gate's bound on a rise from pulse to pulse: below the threshold it costs nothing to keep it."""
GAINS = (0.8, 1.0, 1.2, 1.4, 1.6)
REFERENCE_HZ = 0.4
"""Where a smooth reference's power ends, about."""
LAMBDA = 0.02
PLAN_STEPS = 12
STEP = 0.8
"""Share of the error that is corrected at once where the prediction, not (f, G), is inverted."""
TRACKED = ("gain", "threshold_shift_us", "time_scale")
ROUND_S = 0.25
"""A disturbance begins and ends less sharply than its reported times."""
TRACKED_WITHIN_S = 5.0
"""After a trial the service follows it; that takes half a second."""
LEAST_SHARE = 0.2
"""A trial worse than the one before halves the share of each correction, down to this: near the noise a full correction
only plays the last trial's noise back; some is kept, since a muscle changes."""
GROWTH = 1.5
"""A trial better than the one before makes the share grow by this factor again, up to 1."""


@dataclass(frozen=True)
class Reference:
    """A torque to follow, N·m at the pulses, shape (N,)."""

    torque_nm: np.ndarray

    @classmethod
    def reach(cls, peak_nm: float) -> Reference:
        """Ten seconds: up to half, up to the peak, down to a seventh; minimum-jerk moves between holds (Flash 1985)."""
        parts, level = [np.zeros(8)], 0.0
        for target, move_s, hold_s in ((0.5, 2.3, 0.5), (1.0, 2.2, 0.7), (0.15, 3.2, 0.9)):
            s = np.arange(1, round(move_s * PULSE_RATE_HZ) + 1) / (move_s * PULSE_RATE_HZ)
            parts += [level + (target - level) * (10 * s**3 - 15 * s**4 + 6 * s**5)]
            parts += [np.full(round(hold_s * PULSE_RATE_HZ), target)]
            level = target
        return cls(peak_nm * np.concatenate(parts))

    @property
    def rms_nm(self) -> float:
        """Its root mean square, N·m."""
        return float(np.sqrt(np.mean(self.torque_nm**2)))


class Plant:
    """The model of MODEL.json: f both ways as tables, G as the response to one held pulse, on the grid of pulses."""

    def __init__(self, document: dict[str, Any], size: int) -> None:
        curve, self.document = document["recruitment"], document
        self.width_us, self.level_nm = np.array(curve["pulse_width_us"]), np.array(curve["torque_nm"])
        self.inverse_nm, self.inverse_us = (np.array(curve["inverse"][k]) for k in ("torque_nm", "pulse_width_us"))
        self.widest_us = float(document["valid_for"]["pulse_width_us"][1])
        self.largest_nm = float(self.inverse_nm[-1])
        self.response = pulse_response(document["linear"], float(document["sample_rate_hz"]), size)
        self.G = lower_triangle(self.response)

    def now(self) -> Plant:
        """Return the plant of the last trial, where this one is expected of the next trial; forward only."""
        tracking = self.document.get("tracking")
        if not tracking or tracking["now"] is None:
            return self
        level = {name: (tracking["now"][name]["value"], tracking["coming"][name]["value"]) for name in TRACKED}
        unchanged = (1.0, 1.0)  # a quantity that is not tracked explains nothing: its change is learnt
        moved = [level[name] if name in tracking["moved"] else unchanged for name in TRACKED]
        (gain, of), (shift_us, from_us), (slow, than) = moved
        plant, time = copy.copy(self), np.arange(self.response.size + 1.0)
        plant.level_nm = gain / of * self.level(self.width_us - (shift_us - from_us))
        step = np.interp((time[1:] - 0.5) * than / slow, np.r_[0.0, time[1:] - 0.5], np.r_[0.0, self.response.cumsum()])
        plant.response = np.diff(step, prepend=0.0)
        plant.G = lower_triangle(plant.response)
        return plant

    def undisturbed(self) -> np.ndarray:
        """1 where the last trial was the muscle's answer to its pulses alone, else 0; shape (N,)."""
        time_s = BEFORE_S + np.arange(self.response.size) / PULSE_RATE_HZ
        weight = np.ones(time_s.size)
        for begin_s, end_s in self.document.get("tracking", {}).get("disturbed_s") or ():
            weight[(time_s > begin_s - ROUND_S) & (time_s < end_s + ROUND_S)] = 0.0
        return weight

    def level(self, widths_us: np.ndarray) -> np.ndarray:
        """f, N·m."""
        return np.interp(widths_us, self.width_us, self.level_nm)

    def widths(self, demand_nm: np.ndarray) -> np.ndarray:
        """f⁻¹ in whole µs, shape (N,): what rounding and the rise limit take is given back by the pulses after."""
        widths, owed, last = np.zeros(demand_nm.size), 0.0, 0.0
        for k, demand in enumerate(np.clip(demand_nm, 0.0, self.largest_nm)):
            wanted_us = float(np.interp(demand + owed, self.inverse_nm, self.inverse_us)) if demand > 0 else 0.0
            last = widths[k] = min(round(wanted_us), int(last + RISE_US), int(self.widest_us))
            got = float(self.level(np.array(last)))
            owed = float(np.clip(owed + demand - got, -0.3, 0.3)) if demand > 0 else 0.0
        return widths


def lower_triangle(response: np.ndarray) -> np.ndarray:
    """G as a matrix, shape (N, N)."""
    steps = np.subtract.outer(np.arange(response.size), np.arange(response.size))
    return np.where(steps >= 0, response[np.abs(steps)], 0.0)


def pulse_response(linear: dict[str, Any], rate_hz: float, size: int) -> np.ndarray:
    """Mean torque in each pulse's period after one held pulse of unit demand, shape (N,); B(q)/A(q), sample by sample.

    y[k] = sum_i b[i] w[k - delay - i] - sum_{j>=1} a[j] y[k - j]
    """
    per = max(1, round(rate_hz / PULSE_RATE_HZ))
    b, a, delay = linear["b"], linear["a"], int(linear["delay_samples"])
    driven = np.convolve(np.r_[np.zeros(delay), np.ones(per)], b)
    driven = np.r_[driven, np.zeros(max(0, size * per + 1 - driven.size))]
    y = np.zeros(size * per + 1)
    for k in range(y.size):
        y[k] = driven[k] - sum(a[j] * y[k - j] for j in range(1, min(len(a), k + 1)))
    middle = (y[:-1] + y[1:]) / 2
    return middle.reshape(size, per).mean(axis=1)


# ---- laws -----------------------------------------------------------------------------------------------------------


def norm_optimal(plant: Plant) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """w ← w + (GᵀG + λI)⁻¹ Gᵀ e."""
    learn = np.linalg.solve(plant.G.T @ plant.G + LAMBDA * np.eye(len(plant.G)), plant.G.T)
    return lambda demand_nm, error_nm: demand_nm + learn @ error_nm


def phase_lead(plant: Plant) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """w(t) ← Q[w(t) + γ e(t + τ)]: γ and τ that leave least of a smooth reference after four trials.

    A frequency's error shrinks by |1 - γ z^τ G| a trial; Q ends before that reaches 1.
    """
    size = plant.response.size
    frequency_hz = np.fft.rfftfreq(16 * size, 1 / PULSE_RATE_HZ)
    G = np.fft.rfft(plant.response, 16 * size)
    weight = 1 / (1 + (frequency_hz / REFERENCE_HZ) ** 4) ** 2

    def remaining_error(gain: float, lead: int) -> tuple[float, float]:
        factor = np.abs(1 - gain * G * np.exp(2j * np.pi * frequency_hz * lead / PULSE_RATE_HZ))
        outside = np.flatnonzero(factor >= 0.98)
        reach_hz = float(frequency_hz[outside[0]]) if outside.size else PULSE_RATE_HZ / 2
        learnt = np.where(frequency_hz < 0.7 * reach_hz, np.minimum(factor, 1.0) ** 8, 1.0)
        return float(np.sum(weight * learnt)), reach_hz

    gain, lead = min(((g, n) for g in GAINS for n in range(60)), key=lambda choice: remaining_error(*choice)[0])
    reach_hz = max(remaining_error(gain, lead)[1], 0.2)
    spread = 0.75 * PULSE_RATE_HZ / (2 * np.pi * reach_hz)  # a Gaussian, -3 dB where Q must end
    taps = np.exp(-0.5 * (np.arange(-80, 81) / max(spread, 0.5)) ** 2)

    def smooth(demand_nm: np.ndarray) -> np.ndarray:
        return np.convolve(np.pad(demand_nm, 80, mode="edge"), taps / taps.sum(), mode="valid")

    def law(demand_nm: np.ndarray, error_nm: np.ndarray) -> np.ndarray:
        shifted_nm = np.r_[error_nm[lead:], np.full(lead, error_nm[-1])] if lead else error_nm
        return demand_nm + smooth(gain * shifted_nm)

    return law


LAWS = {"norm-optimal": norm_optimal, "phase-lead": phase_lead}


# ---- the service ----------------------------------------------------------------------------------------------------


class Service:
    """The controller's access to the service for one participant."""

    def __init__(self, client: Client, participant: str) -> None:
        self.client, self.participant = client, participant
        self.known: Any = None
        self.wanted_nm: np.ndarray | None = None

    def fetch(self, tracked: bool = False) -> dict[str, Any]:
        """The approved model, as it is or tracked. It is sent again only if it has changed (ETag).

        Raises
        ------
        HaltedError
            The muscle is no longer as a person approved it: a new test is needed.
        """
        query = {"tracked": True} if tracked else {}
        self.known = self.client.approved_model(self.participant, self.known, **query)
        if reason := self.known.document.get("tracking", {}).get("ask"):
            raise HaltedError(reason)
        return self.known.document

    def fetch_followed(self) -> dict[str, Any]:
        """The tracked model once the trial just played is in it, or the last one if that does not come."""
        patience = time.monotonic() + TRACKED_WITHIN_S
        while True:
            document = self.fetch(tracked=True)
            if self.known.changed or time.monotonic() > patience:
                return document
            time.sleep(0.05)

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Play a trial; its torque above rest in each pulse's period, N·m, and the widths sent, µs, both (N,)."""
        segments = [
            {"name": "rest", "sequence": "rest", "settings": {"duration_s": BEFORE_S}},
            {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": widths_us.tolist()}},
            {"name": "rest", "sequence": "rest", "settings": {"duration_s": AFTER_S}},
        ]
        for test in self.client.follow(self.start(segments)):
            if test["recording_id"]:
                return measured(self.client.recording(test["recording_id"]), widths_us.size)
        raise HaltedError(f"the trial ended as {test['state']}: {test['reason']}")

    def start(self, segments: list[dict[str, Any]], **options: Any) -> str:
        """Start a trial as soon as the rig has rested; the id of its test. The service shows its error."""
        patience = time.monotonic() + 90
        rests = round(BEFORE_S * PULSE_RATE_HZ), round(AFTER_S * PULSE_RATE_HZ)
        wanted_nm = None if self.wanted_nm is None else np.pad(self.wanted_nm, rests).tolist()
        while True:
            try:
                return self.client.start_test(
                    self.participant, kind="sequence", segments=segments, reference_torque_nm=wanted_nm, **options
                )["id"]
            except (Conflict, Invalid) as error:
                if error.code != "rest-needed" or time.monotonic() > patience:
                    raise
            time.sleep(0.3)  # the gate asks for a rest between tests

    def predict(self, model_id: str, widths_us: np.ndarray) -> np.ndarray:
        """Predict a trial's torque with the model, N·m in each pulse's period, shape (N,)."""
        return np.array(self.client.predict(model_id, widths_us.tolist()))


class HaltedError(Exception):
    """The rig stopped, or refuses: a person has to look. The controller does nothing more."""


def measured(recording: bytes, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Torque above the rest before the trial, mean in each pulse's period; and the widths that were really sent."""
    with h5py.File(io.BytesIO(recording)) as file:
        if file.attrs["outcome"] != "completed":
            raise HaltedError(f"the trial ended as {file.attrs['outcome']}: {file.attrs['reason']}")
        time_s, torque_nm = file["torque/time_s"][:], file["torque/torque_nm"][:]
        first = round(BEFORE_S * PULSE_RATE_HZ)
        sent_us = np.nan_to_num(file["pulses/sent_pulse_width_us"][first : first + size])
    baseline_nm = torque_nm[(time_s > 0.3 * BEFORE_S) & (time_s < BEFORE_S)].mean()
    period = np.floor((time_s - BEFORE_S) * PULSE_RATE_HZ).astype(int)
    inside = (period >= 0) & (period < size)
    sums = np.bincount(period[inside], torque_nm[inside], size)
    return sums / np.maximum(1, np.bincount(period[inside], minlength=size)) - baseline_nm, sent_us


# ---- learning -------------------------------------------------------------------------------------------------------


@dataclass
class Trial:
    """One trial: what was played, what came."""

    widths_us: np.ndarray
    torque_nm: np.ndarray
    error_percent: float
    lost_pulses: int


def plan(plant: Plant, reference: Reference) -> np.ndarray:
    """The demand that G's inverse asks for, N·m, shape (N,); bends cost a little, so that noise in G isn't played."""
    size = reference.torque_nm.size
    bend = np.diff(np.eye(size), 2, axis=0)
    demand = np.linalg.solve(plant.G.T @ plant.G + 0.1 * bend.T @ bend, plant.G.T @ reference.torque_nm)
    return np.clip(demand, 0.0, plant.largest_nm)


def follow(
    plant: Plant, demand_nm: np.ndarray, wanted_nm: np.ndarray, predict: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """The demand whose predicted torque is what is wanted: the same law, played on the model with its effects."""
    update, best, lowest = norm_optimal(plant), demand_nm, np.inf
    for _ in range(PLAN_STEPS):
        error_nm = wanted_nm - predict(plant.widths(demand_nm))
        mean_square = float(np.mean(error_nm**2))
        if mean_square < lowest:
            best, lowest = demand_nm, mean_square
        demand_nm = np.clip(update(demand_nm, error_nm), 0.0, plant.largest_nm)
    return best


def learn(
    service: Service,
    model: dict[str, Any],
    reference: Reference,
    law: str,
    trials: int,
    static_start: bool = False,
    tracked: bool = False,
) -> list[Trial]:
    """Play and correct, trial after trial.

    `static_start`: the first trial inverts f alone, as if there were no G. `tracked`: the model is followed; its
    effects then serve the first plan only.
    """
    plant, update, predict = Plant(model, reference.torque_nm.size), None, None
    demand, done = reference.torque_nm if static_start else plan(plant, reference), []
    if model["effects"]:
        predict = partial(service.predict, model["model_id"])
        demand = demand if static_start else follow(plant, demand, reference.torque_nm, predict)
    if tracked or not model["effects"]:
        update = LAWS[law](plant)
    service.wanted_nm = reference.torque_nm
    share, disturbance_nm = 1.0, np.zeros(demand.size)
    for _ in range(trials):
        widths_us = plant.widths(demand)
        torque_nm, sent_us = service.play(widths_us)
        error_nm = reference.torque_nm - torque_nm
        lost = int(np.sum(sent_us != widths_us))
        percent = 100 * float(np.sqrt(np.mean(error_nm**2))) / reference.rms_nm
        if done:
            worse = percent > done[-1].error_percent
            share = max(LEAST_SHARE, share / 2) if worse else min(1.0, GROWTH * share)
        done.append(Trial(widths_us, torque_nm, percent, lost))
        print(f"  trial {len(done):2d}  {percent:6.2f} % of the reference's rms, {lost} pulses lost", file=sys.stderr)
        not_sent_nm = plant.G @ (plant.level(widths_us) - plant.level(sent_us))  # a late pulse is dropped by the rig:
        learnt_nm = error_nm - not_sent_nm  # no reason to learn from it
        if tracked:
            played, plant = plant, Plant(service.fetch_followed(), demand.size)
            now, update = plant.now(), LAWS[law](plant)
            demand = demand + now.level(widths_us) - played.level(widths_us)
            new_nm = torque_nm + not_sent_nm - now.G @ demand - disturbance_nm
            disturbance_nm = disturbance_nm + share * plant.undisturbed() * new_nm
            demand = update(demand, reference.torque_nm - disturbance_nm - plant.G @ demand)
            demand = np.clip(demand, 0.0, plant.largest_nm)
            continue
        if update is not None:
            corrected = demand + share * (update(demand, learnt_nm) - demand)
            demand = np.clip(corrected, 0.0, plant.largest_nm)
        else:
            demand = follow(plant, demand, predict(widths_us) + STEP * share * learnt_nm, predict)
    return done


def draw(path: str, reference: Reference, runs: dict[str, list[Trial]]) -> None:
    """Error over trials, and the last trial's torque beside the reference."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (error_axis, torque_axis) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    time_s = np.arange(reference.torque_nm.size) / PULSE_RATE_HZ
    torque_axis.plot(time_s, reference.torque_nm, "k--", label="reference")
    for name, trials in runs.items():
        error_axis.semilogy(range(1, len(trials) + 1), [trial.error_percent for trial in trials], "o-", label=name)
        torque_axis.plot(time_s, trials[-1].torque_nm, label=f"{name}, trial {len(trials)}")
    error_axis.axhline(5, color="grey", lw=0.8)
    error_axis.set(xlabel="trial", ylabel="tracking error (% of the reference's rms)")
    torque_axis.set(xlabel="time (s)", ylabel="torque (N·m)")
    error_axis.legend(), torque_axis.legend()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Run the laws one after the other and show how the error falls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--participant", required=True)
    parser.add_argument("--law", choices=[*LAWS, "both"], default="both")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--peak-nm", type=float, help="default: 60 %% of the largest torque the model is valid for")
    parser.add_argument("--tracked", action="store_true", help="fetch the model anew after each trial, as it stands")
    parser.add_argument("--svg", help="draw here")
    options = parser.parse_args()
    token = os.environ.get("STIMRIG_TOKEN") or sys.exit("set STIMRIG_TOKEN to a controller's key")
    service = Service(Client(options.url, token), options.participant)
    model = service.fetch(options.tracked)
    if not abs(model["pulse_rate_hz"] / PULSE_RATE_HZ - 1) < 1e-3:
        sys.exit(
            f"the model holds for {model['pulse_rate_hz']:g} pulses a second; this controller plays {PULSE_RATE_HZ:g}"
        )
    reference = Reference.reach(options.peak_nm or 0.6 * float(model["recruitment"]["inverse"]["torque_nm"][-1]))
    laws = list(LAWS) if options.law == "both" else [options.law]
    runs = {}
    for law in laws:
        model = service.fetch(options.tracked)
        runs[law] = learn(service, model, reference, law, options.trials, tracked=options.tracked)
    print(f"model {model['model_id']}, reference {reference.rms_nm:.2f} N·m rms; error in % of it")
    print("trial  " + "  ".join(f"{law:>12}" for law in runs))
    for number in range(options.trials):
        print(f"{number + 1:5d}  " + "  ".join(f"{run[number].error_percent:12.2f}" for run in runs.values()))
    if options.svg:
        draw(options.svg, reference, runs)


if __name__ == "__main__":
    try:
        main()
    except (HaltedError, ServiceError) as error:
        sys.exit(str(error))

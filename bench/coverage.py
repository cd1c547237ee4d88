"""Do 95 % bands hold the truth, also where the structure is wrong?

    python -m bench.coverage [--seeds 760000:760010] [--only right|wrong|tracking] [--json FILE]

*Right*: muscles of the fitted structure; the truth is the muscle's. *Wrong*: muscles of `hardware_sim` that hide an
effect, fitted with the plain structure. The truth of a parameter and of a curve is then what estimates converge to: the
mean over other records of the same muscle, each of its own design and noise. In both, predictions are of another
record of similar design, and their truth is its torque without noise. *Tracking*: sessions of `bench.tracking`,
with a muscle that loses 40 % of its gain and with one that does not change, after a test in which it tires, too. The
truth is the muscle in % of the approved model: its drive over the model's in the middle of the trial, its time constant
over the model's, and a threshold that stays.
"""

from __future__ import annotations

import contextlib
import copy
import io
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.adaptive import paper_test
from bench.common import keep_lines, parser, table
from bench.goals import SharpThreshold, TwoPools, fitted
from bench.tracking import APPROVAL_S, CURRENT_MA, LARGEST_US, NOTHING, PEAK_SHARE, TRIALS, Person, Simulated, patient
from bench.tracking_rivals import FOLLOWERS, OURS
from examples import ilc_controller as ilc
from stimrig import identify
from stimrig.hardware_sim import patients
from stimrig.hardware_sim.hidden.design import make_design
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario, rng_of
from stimrig.hardware_sim.hidden_records import sampled
from stimrig.hardware_sim.offline import simulate
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.estimation.uncertainty import prediction_band
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from tests.harness.patients import Patient, make_record

RATE_HZ, NOISE_NM = 400.0, 0.05
HIDDEN = (
    "activation_dependent_speed", "asymmetric_relaxation", "catch_like", "fatigue", "mixed_fibres",
    "output_saturation", "potentiation", "recruitment_hysteresis",
)  # fmt: skip
"""Effects that a plain model lacks; each of middle strength: it leaves 5 to 10 times the noise."""
RECORDS = 8
"""Of each muscle of a wrong structure."""
PARAMETERS = ("time_constant_s", "damping", "delay_s")
CURVES = {"right": Patient, "two pools": TwoPools, "sharp threshold": SharpThreshold}
"""Curves of the right structure: as most, and two that a spline only comes near."""
Row = dict[str, Any]


def inside(value: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """Share of the places at which a value is within its band."""
    return float(np.mean((value >= lower - 1e-9) & (value <= upper + 1e-9)))


def wide(lower: np.ndarray, upper: np.ndarray, error: np.ndarray) -> float:
    """Half of the band, rms, over the rms of the error; near 2 where the band is as wide as it should be."""
    return float(np.sqrt(np.mean((upper - lower) ** 2)) / 2 / max(np.sqrt(np.mean(error**2)), 1e-12))


def predicted(model: Model, record: Record, clean_nm: np.ndarray) -> Row:
    """Of the torque without noise of another record, the share that the band holds."""
    low, high = prediction_band(model, record)
    return {"prediction": inside(clean_nm, low, high), "wide": wide(low, high, clean_nm - 0.5 * (low + high))}


def bands_of(model: Model) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By kind, lower and upper of each parameter and of both curves."""
    assert model.covariance is not None
    found = {}
    for name in PARAMETERS:
        value, half = model.covariance.values[model.covariance.names.index(name)], 1.96 * model.covariance.sd(name)
        found[name] = np.array([value - half]), np.array([value + half])
    for kind, key, before in (
        ("curve", "recruitment", ""),
        ("whole curve", "recruitment", "whole_"),
        ("step response", "step_response", ""),
    ):
        found[kind] = tuple(model.bands[key][f"{before}{end}"][1:] for end in ("lower", "upper"))
    return found


def places(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Widths and times at which a model has its bands, µs and s."""
    return model.bands["recruitment"]["pulse_width_us"][1:], model.bands["step_response"]["time_s"][1:]


def right(seed: int) -> Iterator[Row]:
    """A muscle of the fitted structure, with three curves."""
    for case, kind in CURVES.items():
        rng = np.random.default_rng(seed)
        patient = kind(**vars(Patient.draw(rng)))
        record, _ = make_record(patient, rng, rate_hz=RATE_HZ, noise_nm=NOISE_NM)
        other, clean = make_record(patient, rng, rate_hz=RATE_HZ, noise_nm=NOISE_NM)
        model = fitted(record, patient)
        late_s = patient.delay_s - sum(effect["parameters"]["delay_s"]["value"] for effect in model.effects)
        widths_us, times_s = places(model)
        truth = {name: np.array([getattr(patient, name)]) for name in PARAMETERS[:2]} | {"delay_s": np.array([late_s])}
        truth["curve"] = patient.recruitment(widths_us)
        linear = SecondOrder(patient.time_constant_s, patient.damping, late_s)
        truth["step response"] = linear.step_response(times_s)
        yield row_of(case, seed, model, truth, predicted(model, other, clean))


def row_of(case: str, seed: int, model: Model, truth: dict[str, np.ndarray], more: Row) -> Row:
    """Shares inside, and whether the whole curve is."""
    ends = bands_of(model)
    row: Row = {"case": case, "seed": seed} | {kind: inside(value, *ends[kind]) for kind, value in truth.items()}
    return row | {"whole curve": float(inside(truth["curve"], *ends["whole curve"]) == 1.0)} | more


def drawn_to(models: list[Model], place: Model) -> dict[str, np.ndarray]:
    """What estimates converge to, at the places of a model's bands: the mean of several models."""
    widths_us, times_s = places(place)
    known = [model.covariance for model in models if model.covariance is not None]
    found = {name: np.array([np.mean([own.values[own.names.index(name)] for own in known])]) for name in PARAMETERS}
    linear = [model.linear for model in models if isinstance(model.linear, SecondOrder)]
    found["curve"] = np.mean([model.recruitment(widths_us) for model in models], axis=0)
    found["step response"] = np.mean([one.step_response(times_s) for one in linear], axis=0)
    return found


def drawn_record(scenario: Scenario, seed: int, number: int) -> tuple[Record, np.ndarray]:
    """Of a muscle, a record with its own design and noise, and its torque without noise."""
    rng = rng_of(seed, "record", str(number))
    design = make_design("full", rng, float(scenario.base.largest_width_us))
    columns = sampled(scenario, design, RATE_HZ, 0.0, np.zeros)
    clean = columns["torque_nm"]
    noisy = clean + NOISE_NM * rng.standard_normal(clean.size)
    return Record.from_arrays(columns["time_s"], columns["pulse_width_us"], noisy, columns["segment"]), clean


def wrong(seed: int) -> Iterator[Row]:
    """For each hidden effect a muscle with it, in several records."""
    for effect in HIDDEN:
        scenario = draw_scenario((effect,), "middle", seed, noise_sd_nm=NOISE_NM)
        records = [drawn_record(scenario, seed, number) for number in range(RECORDS)]
        models = [identify.fit(record) for record, _ in records]
        for number, model in enumerate(models):
            truth = drawn_to(models[:number] + models[number + 1 :], model)
            yield row_of(effect, seed, model, truth, predicted(model, *records[(number + 1) % RECORDS]))


def lines_of(rows: list[Row]) -> list[str]:
    """A table: by case, coverage of each kind in per cent."""
    lines, kinds = [], list(dict.fromkeys(kind for row in rows for kind in row if kind not in ("case", "seed", "wide")))
    for case in [*dict.fromkeys(row["case"] for row in rows), "all"]:
        own = [row for row in rows if case in (row["case"], "all")]
        cells = []
        for kind in kinds:
            shares = [row[kind] for row in own if kind in row]
            cells.append(f"{100 * np.mean(shares):.1f}" if shares else "")
        ratio = f"{np.median([row['wide'] for row in own]):.1f}" if "wide" in own[0] else ""
        lines.append([case, len({row["seed"] for row in own}), len(own), *cells, ratio])
    return table(["case", "muscles", "records", *kinds, "half band / error"], lines)


class Watched(Person):
    """Its twin never changes. Of each record, the gain in its middle, by least squares, and the widths are kept."""

    def __init__(self, seed: int, case: str) -> None:
        super().__init__(seed, case)
        self.twin: Any = patients.make("changing", patient(seed, NOTHING))
        self.played: list[tuple[float, np.ndarray]] = []

    def play(self, widths_us: np.ndarray, names: list[str]) -> Record:
        """As the person plays it."""
        begun_s, span_s = self.now_s, widths_us.size / ilc.PULSE_RATE_HZ
        record = super().play(widths_us, names)
        times_s = begun_s + np.arange(widths_us.size) / ilc.PULSE_RATE_HZ
        still = simulate(copy.deepcopy(self.twin), times_s, widths_us, CURRENT_MA, RATE_HZ, span_s, begun_s)
        self.played.append((in_middle(record.torque_nm, still), widths_us))
        return record

    def gains(self, model: Model) -> list[float]:
        """Of each trial, the muscle's drive over the approved model's."""
        full_nm, recruited = self.twin.parameters.largest_nm, self.twin.recruited
        own = [np.array([full_nm * recruited(width, CURRENT_MA) for width in widths]) for _, widths in self.played]
        return [
            gain * in_middle(drive, model.recruitment(widths))
            for (gain, widths), drive in zip(self.played[1:], own[1:], strict=True)
        ]


def in_middle(value: np.ndarray, of: np.ndarray) -> float:
    """Factor on `of` that gives a value, in the middle; it may run from begin to end."""
    run = np.linspace(-0.5, 0.5, of.size)
    return float(np.linalg.lstsq(np.c_[of, of * run], value, rcond=None)[0][0])


def tracking(seed: int) -> Iterator[Row]:
    """Sessions of ten trials: the bands of each trial, and those that were expected of it."""
    for case in (NOTHING, "fatigue"):
        person = Watched(seed, case)
        test = person.play(*paper_test(LARGEST_US, held_out=True))
        person.now_s += APPROVAL_S
        model = identify.fit(test)
        top_nm = float(model.to_dict()["recruitment"]["inverse"]["torque_nm"][-1])
        service: Any = Simulated(person, FOLLOWERS[OURS](model, test))  # pyright: ignore[reportOptionalCall]
        with contextlib.redirect_stderr(io.StringIO()):
            reference = ilc.Reference.reach(PEAK_SHARE * top_nm)
            ilc.learn(service, model.to_dict(), reference, "norm-optimal", TRIALS, tracked=True)
        assert isinstance(model.linear, SecondOrder)
        period_s = model.linear.time_constant_s
        still = {"threshold_shift_us": 0.0, "time_scale": person.twin.parameters.natural_period_s / period_s}
        for number, gain in enumerate(person.gains(model)):
            truth = {"gain": gain} | still
            row: Row = {"case": case, "seed": seed}
            for when, served in (("now", service.served[number]), ("coming", service.served[max(number - 1, 0)])):
                if number or when == "now":
                    for name, value in truth.items():
                        band = served[when][name]
                        row[f"{name}, {when}"] = float(band["low"] <= value <= band["high"])
            yield row


RUNS = {"right": right, "wrong": wrong, "tracking": tracking}


def main() -> None:
    """Print the tables."""
    made = parser(__doc__, "760000:760010")
    made.add_argument("--only", choices=list(RUNS), action="append")
    options = made.parse_args()
    kept: list[Row] = []
    for name in options.only or RUNS:
        rows: list[Row] = []
        for seed in options.seeds:
            rows += RUNS[name](seed)
            print(f"{name}, seed {seed}", file=sys.stderr, flush=True)
        kept += rows
        keep_lines(options.json, kept)
        print(*lines_of(rows), "", sep="\n", flush=True)


if __name__ == "__main__":
    main()

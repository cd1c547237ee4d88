"""The diagnosis on muscles made by other equations; the wide tables are in bench/diagnosis.py."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import cache

import numpy as np
import pytest

from bench.muscles.hidden_records import generate
from stimrig import identify
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.errors import Cancelled
from stimrig.identify.records.record import Record
from stimrig.identify.results import Diagnosis
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record
from tests.harness.patients import Patient, make_record
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow

OTHERS = (
    "electromechanical_delay", "mains_hum", "output_saturation", "voluntary_effort", "asymmetric_relaxation",
    "threshold_drift", "tremor", "baseline_drift", "sensor_clipping",
)  # fmt: skip
FEW = (
    "fatigue",
    "asymmetric_relaxation",
    "electromechanical_delay",
    "mains_hum",
    "output_saturation",
    "baseline_drift",
)
"""Of each stage. Where these are tried alone, a campaign tries the whole library."""


@cache
def diagnosed(hidden: str, seed: int, ar1: float, library: tuple[str, ...]) -> Diagnosis:
    """Of a muscle with something hidden in it, or nothing; with the whole library if none is named."""
    return diagnosed_with(library, hidden_muscles.record(hidden, seed=seed, ar1=ar1))


def diagnosed_with(library: tuple[str, ...], record: Record) -> Diagnosis:
    with few_effects.only(*library) if library else nullcontext():
        return diagnose(record)


both_libraries = pytest.mark.parametrize("library", [FEW, pytest.param((), marks=pytest.mark.campaign, id="whole")])


@pytest.mark.parametrize(
    ("hidden", "library"),
    [
        ("fatigue", ()),
        (OTHERS[0], FEW),
        *(pytest.param(name, (), marks=pytest.mark.campaign) for name in OTHERS),
    ],
)
def test_what_is_hidden_is_named_first_and_removed(hidden, library):
    result = diagnosed(hidden, 11, 0.0, library)
    json.dumps(result.to_dict(), allow_nan=False)
    assert result.verdict == "effect_missing"
    first = result.missing[0]
    assert first["effect"] == hidden or hidden in first["confused_with"], (first["effect"], first["confused_with"])
    assert 0.0 < first["probability"] <= 1.0
    noise = 0.04
    before, after = first["rms_before_nm"], first["rms_after_nm"]
    # What is above the noise falls to less than a third.
    assert after**2 - noise**2 < 0.11 * (before**2 - noise**2) + 0.2 * noise**2


@pytest.mark.parametrize(
    ("seed", "ar1", "library"),
    [
        (21, 0.0, ()),
        (23, 0.99, ()),
        pytest.param(22, 0.9, (), marks=pytest.mark.campaign),
    ],
)
def test_where_nothing_is_hidden_nothing_is_named(seed, ar1, library):
    result = diagnosed("", seed, ar1, library)
    assert result.verdict == "nothing_missing" and result.missing == ()
    assert result.probability > 0.5


def test_two_effects_are_named_beside_each_other():
    record = as_record(generate(("fatigue", "asymmetric_relaxation"), "middle", 9, rate_hz=100))
    result = diagnosed_with(("fatigue", "asymmetric_relaxation", "threshold_drift"), record)
    assert result.verdict == "effect_missing"
    assert {row["effect"] for row in result.missing} == {"fatigue", "asymmetric_relaxation"}


@both_libraries
@pytest.mark.parametrize(
    ("slow_s", "quick_s", "noise_nm", "gaps_s"),
    [
        (0.05, 5e-5, 0.04, ()),
        (0.6, 0.1, 0.02, ((4.2, 5.6), (11.0, 11.6))),
    ],
)
def test_a_quick_muscle_and_a_slow_one_with_gaps_lack_nothing(slow_s, quick_s, noise_nm, gaps_s, library):
    rng = np.random.default_rng(1)
    widths, names = hidden_muscles.protocol(rng)
    lag_s = np.sqrt(slow_s * quick_s)
    patient = Patient(time_constant_s=lag_s, damping=0.5 * (slow_s + quick_s) / lag_s)
    record, _ = make_record(patient, rng, noise_nm=noise_nm, pulses=(widths, list(names)))
    for begin_s, end_s in gaps_s:
        record = record.take((record.time_s < begin_s) | (record.time_s >= end_s))
    result = diagnosed_with(library, record)
    assert result.verdict == "nothing_missing", result.missing


@both_libraries
def test_a_spline_s_own_error_is_nothing_missing(library):
    result = diagnosed_with(library, as_record(generate(None, "middle", 1, noise_sd_nm=5e-5)))
    assert result.verdict == "nothing_missing", result.missing


def test_noise_is_estimated_and_places_are_worded():
    result = diagnosed("fatigue", 11, 0.0, ())
    assert abs(result.noise_sd_nm - 0.04) < 0.004
    place = result.where[0]
    assert {"segment", "start_s", "end_s", "pulse_width_us", "direction", "share_of_excess"} <= set(place)
    assert place["segment"] in place["text"] and "N·m" in place["text"]
    record = hidden_muscles.record("fatigue", seed=11)
    compared = identify.compare(identify.fit(record), record)
    starts = [[place["start_s"] for place in found.where] for found in (result, compared)]
    assert starts[0] == starts[1], "the same places, whoever is asked"


def test_held_out_rows_are_only_reported():
    """Nor do they choose the hum, which is looked for in the samples."""
    record = hidden_muscles.record("output_saturation", seed=11)
    record = record.with_torque(record.torque_nm + 0.3 * np.sin(2 * np.pi * 50.0 * record.time_s))
    spoilt = record.with_torque(np.where(record.held_out, 50.0 * np.sin(9.0 * record.time_s), record.torque_nm))
    with few_effects.only("output_saturation", "baseline_drift", "mains_hum"):
        one, two = diagnose(record), diagnose(spoilt)
    assert one.candidates == two.candidates
    assert one.missing[0]["parameters"] == two.missing[0]["parameters"]
    assert one.base["held_out_rms_nm"] != two.base["held_out_rms_nm"]


def test_effects_of_movement_are_no_candidates_without_its_columns():
    result = diagnosed("", 21, 0.0, ())
    tried = {c["effect"] for row in result.candidates for c in row}
    assert tried and not tried & {"torque_angle", "torque_velocity", "passive_torque"}


def test_progress_is_told_and_can_stop_it():
    heard = []

    def progress(share: float, text: str) -> None:
        heard.append((share, text))
        if len(heard) > 4:
            raise Cancelled("enough")

    with few_effects.only(*FEW), pytest.raises(Cancelled):
        diagnose(hidden_muscles.record(seed=71, rate_hz=100), progress=progress)
    assert all(0.0 <= share <= 1.0 and text for share, text in heard)


def test_a_gain_that_swings_is_no_effect_of_the_library():
    record = hidden_muscles.record(seed=91)
    clean = hidden_muscles.muscle(hidden_muscles.protocol(np.random.default_rng(91))[0])[::5]
    swing = 0.12 * np.sin(2.1 * record.time_s) * clean
    result = diagnosed_with(FEW, record.with_torque(record.torque_nm + swing))
    assert result.verdict == "unexplained_structure"
    assert all(entry["probability"] < 0.5 for entry in result.missing)

"""A short record: a curve that never falls, near a sigmoid or near the person's last curve."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.errors import BadRequest
from stimrig.identify.experiments.adaptive import Target
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from tests.harness.adaptive import play, recorded, shaped, sigmoid

pytestmark = pytest.mark.slow


def short_test(muscle, seed: int, sign: float = 1.0, zero_nm: float = 0.0) -> Record:
    top = muscle.top_us
    widths = np.r_[np.zeros(20), np.linspace(0.0, top, 80), np.full(10, top), np.zeros(20), np.full(30, 0.5 * top)]
    noise = np.random.default_rng([seed, 78]).standard_normal(4000) * 0.05
    record = recorded(muscle, widths, ["short"] * widths.size, noise)
    return Record.from_arrays(record.time_s, record.pulse_width_us, zero_nm + sign * record.torque_nm)


def error_percent(model: Model, muscle) -> float:
    u = np.linspace(0.0, muscle.top_us, 61)
    return (
        100.0
        * float(np.max(np.abs(np.abs(model.recruitment(u)) - muscle.curve(u))))
        / float(muscle.curve(muscle.top_us))
    )


@pytest.mark.parametrize("make", [sigmoid, shaped])
def test_the_curve_never_falls_and_its_band_contains_the_truth(make):
    muscle = make(51_010)
    model = identify.fit(short_test(muscle, 51_010), recruitment="near-sigmoid")
    u = np.linspace(0.0, muscle.top_us, 301)
    assert np.all(np.diff(model.recruitment(u)) >= -1e-3 * muscle.curve(muscle.top_us))
    band = model.bands["recruitment"]
    true, slack = muscle.curve(np.asarray(band["pulse_width_us"])), 0.02 * muscle.curve(muscle.top_us)
    assert np.all((band["whole_lower"] - slack <= true) & (true <= band["whole_upper"] + slack))


def test_a_short_record_of_a_sigmoid_says_more_than_with_a_free_spline():
    muscles = [sigmoid(seed) for seed in range(51_011, 51_015)]
    records = [short_test(muscle, seed) for seed, muscle in enumerate(muscles)]
    near = [
        error_percent(identify.fit(r, recruitment="near-sigmoid"), m) for r, m in zip(records, muscles, strict=True)
    ]
    free = [error_percent(identify.fit(r), m) for r, m in zip(records, muscles, strict=True)]
    assert np.mean(near) < 0.7 * np.mean(free)


def test_direction_and_zero_of_the_load_cell_do_not_matter():
    muscle = sigmoid(51_015)
    one = identify.fit(short_test(muscle, 1), recruitment="near-sigmoid")
    other = identify.fit(short_test(muscle, 1, sign=-1.0, zero_nm=4.0), recruitment="near-sigmoid")
    u = np.linspace(0.0, 300.0, 31)
    np.testing.assert_allclose(other.recruitment(u), -one.recruitment(u), atol=0.02 * muscle.curve(300.0))
    assert other.baseline_nm == pytest.approx(4.0 - one.baseline_nm, abs=0.02)


def test_the_last_model_narrows_the_next_one():
    muscle = shaped(51_016)
    seen = play(muscle, np.random.default_rng(79).standard_normal(16_000) * 0.05, Target(), left_s=30.0, left_nm_s=1e3)
    assert seen.record is not None
    last = identify.fit(seen.record, recruitment="near-sigmoid")
    new = identify.fit(short_test(muscle, 3), recruitment="near-sigmoid")
    known = identify.fit(short_test(muscle, 3), recruitment="near-sigmoid", earlier=last)
    width = [
        np.mean(np.subtract(m.bands["recruitment"]["upper"], m.bands["recruitment"]["lower"])) for m in (new, known)
    ]
    assert width[1] < width[0]
    assert Model.from_json(known.to_json()).recruitment(200.0) == pytest.approx(known.recruitment(200.0))


@pytest.mark.parametrize(
    "options",
    [{"knots": 31}, {"monotone": True}, {"earlier": "a file"}, {"delay_s": 0.01}],
    ids=["knots", "monotone", "earlier", "delay"],
)
def test_options_of_other_curves_are_refused(options):
    with pytest.raises(BadRequest):
        identify.fit(short_test(sigmoid(51_017), 4), recruitment="near-sigmoid", **options)

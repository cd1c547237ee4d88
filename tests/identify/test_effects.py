"""The library: complete, neutral where it says so, and able to be written down and read back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig.hardware_sim.hidden.library import EFFECTS
from stimrig.identify import fit
from stimrig.identify.effects import find_effect, library, registry
from stimrig.identify.effects.base import STAGES, Scene
from stimrig.identify.errors import BadModel, BadRequest, NotIdentifiable
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.model import Model
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record
from tests.identify import hidden_muscles

CONTRACT = {
    "fatigue", "potentiation", "recruitment_hysteresis", "asymmetric_relaxation", "electromechanical_delay",
    "mixed_fibres", "threshold_drift", "baseline_drift", "voluntary_effort", "tremor", "mains_hum",
    "output_saturation", "sensor_clipping", "series_compliance", "torque_angle", "torque_velocity", "passive_torque",
    "activation_dependent_speed", "catch_like",
}  # fmt: skip
FORMS = [(effect.id, form.name) for effect in registry().values() for form in effect.forms]


@pytest.fixture(scope="module")
def moving() -> Record:
    base = hidden_muscles.record(seed=3, rate_hz=100)
    angle = 1.4 + 0.2 * np.sin(0.7 * base.time_s)
    return replace(base, angle_rad=angle, velocity_rad_s=np.gradient(angle, base.time_s))


@pytest.fixture(scope="module")
def setup(moving):
    grid, _ = prepare(moving)
    return fit_plain(grid, grid.fitted).problem.setup


def _theta(problem: Problem) -> np.ndarray:
    values = [0.2, 0.9, 0.001, 0.05, 0.0, 0.0, *np.linspace(0.0, 6.0, problem.setup.basis.size)]
    return problem.from_physical(np.array(values + [p.neutral for c in problem.chosen for p in c.parameters]))


def test_every_id_of_the_contract_is_there_and_every_effect_has_its_hidden_twin():
    named = {effect.id for effect in registry().values() if effect.shape is None}
    assert set(EFFECTS) == named >= CONTRACT


def test_the_library_is_plain_data_with_everything_a_page_shows():
    rows = library()
    json.dumps(rows, allow_nan=False)
    for row in rows:
        assert row["stage"] in STAGES
        assert len(row["plain"]) > 60
        for key in ("equation", "signature", "separated_by", "source"):
            assert row[key], (row["id"], key)
        for parameter in row["parameters"]:
            low, high = parameter["range"]
            assert low < high and parameter["unit"]
        assert set(row["confused_with"]) <= set(registry())


@pytest.mark.parametrize(("effect", "name"), FORMS)
def test_a_form_is_the_base_at_its_neutral_values_bit_for_bit_and_elsewhere_finite_and_another(setup, effect, name):
    form = find_effect(effect).form(name)
    base, problem = Problem(setup, []), Problem(setup, [(effect, form)])
    neutral = problem.run(_theta(problem))[0]
    assert np.array_equal(neutral, base.run(_theta(base))[0])
    if len(form.parameters) > 40:
        return
    values = problem.physical(_theta(problem))
    for place, p in zip(problem.chosen[0].places, problem.chosen[0].parameters, strict=True):
        values[place] = p.lower + 0.7 * (p.upper - p.lower) if p.scale == "linear" else np.sqrt(p.lower * p.upper)
    mean, slopes = problem.run(problem.from_physical(values), derivatives=True)
    assert slopes is not None and np.all(np.isfinite(mean)) and np.all(np.isfinite(slopes))
    assert form.fixed or np.max(np.abs(mean - neutral)) > 1e-4


def test_effects_compose_fit_predict_and_serialise(moving):
    model = fit(moving, effects=["fatigue", "torque_angle:parabola", "baseline_drift:linear"])
    again = Model.from_json(model.to_json())
    assert [e["id"] for e in again.effects] == ["fatigue", "torque_angle", "baseline_drift"]
    np.testing.assert_allclose(again.predict(moving), model.predict(moving), atol=1e-9)
    assert all(p["sd"] >= 0 and p["unit"] for e in again.effects for p in e["parameters"].values())
    assert again.covariance is not None and len(again.covariance.names) == len(again.covariance.values)


def test_parameters_are_found_within_their_uncertainty():
    """Drift of 0.9 µs/s and of 0.03 N·m/s, put in by hand: found within three standard deviations."""
    for hidden, name, truth in (("threshold_drift", "slope_us_per_s", 0.9), ("baseline_drift", "slope_nm_per_s", 0.03)):
        found = fit(hidden_muscles.record(hidden, seed=5), effects=[f"{hidden}:linear"]).effects[0]["parameters"][name]
        assert abs(found["value"] - truth) < 3.5 * found["sd"] + 0.02 * truth
        assert found["sd"] < 0.2 * truth


def test_what_cannot_be_had_is_said(moving):
    with pytest.raises(BadRequest, match="Known"):
        fit(moving, effects=["witchcraft"])
    with pytest.raises(BadRequest, match="no form"):
        fit(moving, effects=["fatigue:nonsense"])
    with pytest.raises(NotIdentifiable, match="angle_rad"):
        fit(hidden_muscles.record(rate_hz=100), effects=["torque_angle"])


@pytest.mark.parametrize("name", ["bumps_1", "resisting_1", "spasms_1"])
@pytest.mark.parametrize("size", [60, 200, 400])
def test_an_effort_is_proposed_where_it_is(name: str, size: int):
    """Also in a record that is shorter than the widest shape that is tried."""
    form = find_effect("voluntary_effort").form(name)
    scene = Scene(0.025 * np.arange(size), np.zeros(size), 0.025, 8.0, 200.0)
    at_s = 0.6 * scene.span_s
    values = {p.name: np.full((1, 1), p.on(scene).start[0]) for p in form.parameters} | {
        "centre_0_s": np.full((1, 1), at_s),
        "width_0_s": np.full((1, 1), 0.2),
        "decay_0_s": np.full((1, 1), 0.3),
    }
    residual_nm = form.call(None, values, scene)[0]
    assert form.propose is not None
    for proposed in form.propose(residual_nm, scene, {}):
        assert proposed["centre_0_s"] == pytest.approx(at_s, abs=0.2)


# ---- impossible numbers in a model file ------------------------------------------------------------------------

SETTINGS = {"scale_nm": 7.0, "noise_sd_nm": 0.04, "zero_nm": 0.0, "sign": 1.0, "reference_s": 0.0}
SPOILED = (0.0, float("nan"), float("inf"), 1e9, -1e9, -1.0, 1e-12)


@pytest.fixture(scope="module")
def plain(moving: Record) -> dict[str, Any]:
    return fit(moving).to_dict()


@pytest.fixture(scope="module")
def brief(moving: Record) -> Record:
    """Three seconds with a pause, so that every spoiled form is predicted soon."""
    return moving.take(np.arange(150, 450))


def with_effect(plain: dict[str, Any], effect: str, form: str, parameters: dict[str, float], **settings: float):
    entry = {"id": effect, "form": form, "parameters": parameters, "settings": SETTINGS | settings}
    return plain | {"effects": [entry]}


def spoiled(good: dict[str, float]) -> Iterator[dict[str, float]]:
    yield from (dict.fromkeys(good, value) for value in SPOILED)
    yield from (good | {name: value} for name in good for value in (0.0, -1e9, 1e-12))


@pytest.mark.parametrize("effect", sorted(registry()))
def test_an_effect_with_spoiled_parameters_is_refused_or_predicts(effect: str, brief, plain):
    scene = Scene(brief.time_s, brief.pulse_width_us, 0.025, 7.0, 300.0, noise_sd_nm=0.04)
    angles = {"reference_rad": 1.5, "angle_range_rad": [0.5, 2.5]} if registry()[effect].moves_with_joint else {}
    for form in registry()[effect].forms:
        good = {p.name: p.on(scene).start[0] for p in form.parameters}
        if len(good) > 9:
            continue
        model = Model.from_dict(with_effect(plain, effect, form.name, good, **angles))
        assert np.isfinite(model.predict(brief)).all()
        refused = 0
        for parameters in spoiled(good):
            try:
                model = Model.from_dict(with_effect(plain, effect, form.name, parameters, **angles))
            except BadModel as error:
                refused += 1
                assert "\n" not in str(error) and "is not a number from" in str(error)
            else:
                assert np.isfinite(model.predict(brief)).all(), parameters
        assert refused


@pytest.mark.parametrize(
    "name, value",
    [("sign", 0.0), ("sign", 2.0), ("scale_nm", 0.0), ("scale_nm", -1.0), ("scale_nm", float("inf")),
     ("noise_sd_nm", -0.1), ("noise_sd_nm", float("nan")), ("zero_nm", float("inf")), ("reference_s", float("nan"))],
)  # fmt: skip
def test_settings_of_an_effect_are_checked(name: str, value: float, plain):
    good = {"depth": 0.3, "onset_s": 20.0, "recovery_s": 40.0}
    with pytest.raises(BadModel, match=rf"effects\.0\.settings\.{name}: .* is no"):
        Model.from_dict(with_effect(plain, "fatigue", "fitness", good, **{name: value}))


def test_an_effect_that_is_not_installed_is_still_read(plain):
    """Its page can be shown; only a prediction needs the effect."""
    text = json.dumps(with_effect(plain, "of_another_house", "", {"gain": 1e9}))
    assert Model.from_json(text).effects[0]["id"] == "of_another_house"

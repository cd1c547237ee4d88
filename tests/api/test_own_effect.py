"""A term written as an own effect: the file is loaded and predicts as the term does; a rate is refused in one line."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts.model_charts import model_figures
from stimrig.api.export.own_effect import own_effect
from stimrig.identify.effects import find_effect, registry
from stimrig.identify.records.join import join
from tests.identify import hidden_muscles

TERM = "free_width_by_torque"


def model_with(effect: str, model: identify.Model) -> identify.Model:
    """With a free effect at a lag of 0.25 s."""
    values = {p.name: {"value": p.start[0] or -0.5, "sd": 0.1} for p in find_effect(effect).forms[0].parameters}
    shape = {"words": "A term.", "behaves_as": []}
    entry = {"id": effect, "form": "term", "equation": "u exp(z)", "parameters": values, "shape": shape}
    return model.with_(effects=({**entry, "settings": {"scale_nm": 6.0}},))


@pytest.fixture(scope="module")
def plain() -> identify.Model:
    return identify.fit(hidden_muscles.record(rate_hz=100))


def test_an_own_effect_reaches_the_error_of_the_term(plain, tmp_path, monkeypatch):
    record = hidden_muscles.record(rate_hz=100)
    noise_nm = np.random.default_rng(0).normal(0.0, 0.05, record.torque_nm.size)
    record = record.with_torque(model_with(TERM, plain).predict(record) + noise_nm)
    term = identify.fit(record, effects=[TERM])
    assert {f"free-{TERM}", f"course-{TERM}"} <= model_figures(term.to_dict(), None).keys()
    text = own_effect(term)
    assert len(text.splitlines()) < 40 and term.effects[0]["shape"]["words"] in text
    (tmp_path / "own.py").write_text(text)
    monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(tmp_path))
    own = identify.fit(record, effects=["own_width_by_torque"])
    assert own.fit["rms_nm"] < 1.05 * term.fit["rms_nm"] < 0.5 * identify.fit(record).fit["rms_nm"]


def test_every_term_that_a_stage_can_express_is_written_and_loaded(plain, tmp_path, monkeypatch):
    free = [effect.id for effect in registry().values() if effect.shape and "_rate_" not in effect.id]
    for effect in free:
        (tmp_path / f"{effect}.py").write_text(own_effect(model_with(effect, plain)))
    monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(tmp_path))
    assert len(registry().keys() & {effect.replace("free_", "own_", 1) for effect in free}) == len(free)


def test_the_first_of_several_terms_says_that_its_values_are_from_all(plain):
    both = [model_with(name, plain).effects[0] for name in (TERM, "free_torque_by_drive")]
    assert "from the fit" not in own_effect(plain.with_(effects=(both[0],)))
    text = own_effect(plain.with_(effects=tuple(both)))
    assert 'id="own_width_by_torque"' in text and "from the fit with all 2 terms together" in text


def test_what_is_written_predicts_as_the_term_does_in_a_joined_record_too(plain, tmp_path, monkeypatch):
    first = hidden_muscles.record(rate_hz=40)
    second = first.with_torque(first.torque_nm + np.random.default_rng(1).normal(0.0, 0.01, first.torque_nm.size))
    record = join([first, second], [0.0, float(first.time_s[-1]) + 20.0])
    terms = ("torque_by_drive", "factor_by_fall", "torque_by_pulses", "torque_by_torque_play", "strength_by_rise")
    models = {name: model_with(f"free_{name}", plain) for name in terms}
    for model in models.values():
        for parameter, value in model.effects[0]["parameters"].items():
            value["value"] = 8.0 if parameter == "lag_s" else value["value"]
    for name, model in models.items():
        (tmp_path / f"{name}.py").write_text(own_effect(model))
    monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(tmp_path))
    for name, model in models.items():
        entry = {key: value for key, value in model.effects[0].items() if key != "shape"} | {"id": f"own_{name}"}
        term, own, none = (each.predict(record) for each in (model, model.with_(effects=(entry,)), plain))
        assert np.std(own - term) < 0.03 * np.std(term - none), name


def test_without_a_term_or_with_a_rate_nothing_is_written(plain):
    with pytest.raises(identify.IdentifyError, match="no free effect was found"):
        own_effect(plain)
    with pytest.raises(identify.IdentifyError, match="changes a rate"):
        own_effect(model_with("free_first_rate_by_rise", plain))

"""A model file whose effects hold impossible numbers is refused when it is read, or predicts finite torques."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.effects import registry
from stimrig.identify.effects.base import Form, Scene
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow

SETTINGS = {"scale_nm": 7.0, "noise_sd_nm": 0.04, "zero_nm": 0.0, "sign": 1.0, "reference_s": 0.0}
SPOILED = (0.0, float("nan"), float("inf"), 1e9, -1e9, -1.0, 1e-12)


@pytest.fixture(scope="module")
def record() -> identify.Record:
    found = hidden_muscles.record(rate_hz=100)
    angle_rad = 0.3 * np.sin(found.time_s)
    return replace(found, angle_rad=angle_rad, velocity_rad_s=np.gradient(angle_rad, found.time_s))


@pytest.fixture(scope="module")
def plain(record: identify.Record) -> dict[str, Any]:
    return identify.fit(record).to_dict()


def with_effect(plain: dict[str, Any], effect: str, form: str, parameters: dict[str, float], **settings: float):
    entry = {"id": effect, "form": form, "parameters": parameters, "settings": SETTINGS | settings}
    return plain | {"effects": [entry]}


def started(form: Form, record: identify.Record) -> dict[str, float]:
    scene = Scene(record.time_s, record.pulse_width_us, 0.025, 7.0, 300.0, noise_sd_nm=0.04)
    return {p.name: p.on(scene).start[0] for p in form.parameters}


def spoiled(good: dict[str, float]) -> Iterator[dict[str, float]]:
    for value in SPOILED:
        yield dict.fromkeys(good, value)
        yield from (good | {name: value} for name in good)


@pytest.mark.parametrize("effect", sorted(registry()))
def test_an_effect_with_spoiled_parameters_is_refused_or_predicts(effect: str, record, plain):
    for form in registry()[effect].forms:
        good = started(form, record)
        if len(good) > 14:
            continue
        model = identify.Model.from_dict(with_effect(plain, effect, form.name, good))
        assert np.isfinite(identify.predict(model, record)).all()
        refused = 0
        for parameters in spoiled(good):
            try:
                model = identify.Model.from_dict(with_effect(plain, effect, form.name, parameters))
            except identify.BadModel as error:
                refused += 1
                assert "\n" not in str(error) and "is not a number from" in str(error)
            else:
                assert np.isfinite(identify.predict(model, record)).all(), parameters
        assert refused


@pytest.mark.parametrize(
    "name, value",
    [("sign", 0.0), ("sign", 2.0), ("scale_nm", 0.0), ("scale_nm", -1.0), ("scale_nm", float("inf")),
     ("noise_sd_nm", -0.1), ("noise_sd_nm", float("nan")), ("zero_nm", float("inf")), ("reference_s", float("nan"))],
)  # fmt: skip
def test_settings_of_an_effect_are_checked(name: str, value: float, plain):
    good = {"depth": 0.3, "onset_s": 20.0, "recovery_s": 40.0}
    with pytest.raises(identify.BadModel, match=rf"effects\.0\.settings\.{name}: .* is no"):
        identify.Model.from_dict(with_effect(plain, "fatigue", "fitness", good, **{name: value}))


def test_an_effect_that_is_not_installed_is_still_read(plain):
    """Its page can be shown; only a prediction needs the effect."""
    text = json.dumps(with_effect(plain, "of_another_house", "", {"gain": 1e9}))
    assert identify.Model.from_json(text).effects[0]["id"] == "of_another_house"

"""Best-fit % where the torque is level, and the gap on rows not seen in the verdict."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.criticism import compare
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.estimation.fit_statistics import UNDEFINED, best_fit_percent, ceiling_percent
from stimrig.identify.estimation.quality import quality
from tests.harness.patients import Patient, make_record


@pytest.fixture(scope="module")
def record() -> identify.Record:
    return make_record(Patient(), np.random.default_rng(2), rate_hz=100, noise_nm=0.05)[0]


@pytest.fixture(scope="module")
def model(record: identify.Record) -> identify.Model:
    return identify.fit(record)


@pytest.mark.parametrize("torque", [[], [0.3], [0.3] * 9, [0.1 + 0.2, 0.3] * 5, [1e6, 1e6 + 1e-6]])
def test_level_torque_has_no_best_fit(torque: list[float]) -> None:
    measured = np.array(torque)
    assert np.isnan(best_fit_percent(measured, measured + 1.0))
    assert np.isnan(ceiling_percent(measured, 0.1))


@pytest.mark.parametrize("effects", [(), ("fatigue",)])
def test_a_model_of_level_held_out_rows(record: identify.Record, effects: tuple[str, ...]) -> None:
    level = record.with_torque(np.where(record.held_out, 0.25, record.torque_nm))
    found = identify.fit(level, effects=effects)
    again = identify.Model.from_json(found.to_json())
    assert again.fit["held_out_fit_percent"] is None and again.fit["held_out_ceiling_percent"] is None
    assert found.quality["verdict"] == "not usable" and "whose torque is constant" in found.quality["words"]
    grid = make_grid(level)
    assert quality(again, grid, grid.fitted)["words"] == found.quality["words"]
    assert any(UNDEFINED in line for line in compare(again, level).plain)


@pytest.mark.parametrize(("error", "verdict"), [(0.055, "usable"), (0.15, "usable with care"), (0.5, "not usable")])
def test_an_error_on_level_rows_not_seen_counts(
    record: identify.Record, model: identify.Model, error: float, verdict: str
) -> None:
    level = {"held_out_fit_percent": None, "held_out_ceiling_percent": None, "held_out_rms_nm": error}
    assert judged(model, record, **level)["verdict"] == verdict


def judged(model: identify.Model, record: identify.Record, **fit: Any) -> dict[str, Any]:
    grid = make_grid(record)
    return quality(model.with_(fit=model.fit | fit), grid, grid.fitted)


@pytest.mark.parametrize(
    ("reached", "rms_nm", "verdict"),
    [
        (97.0, 0.051, "usable"),
        (95.0, 0.06, "usable with care"),
        (85.0, 0.06, "usable with care"),
        (85.0, 0.3, "not usable"),
        (-8.6e16, 3.0, "not usable"),
    ],
)
def test_the_gap_on_rows_not_seen_is_in_the_verdict(
    record: identify.Record, model: identify.Model, reached: float, rms_nm: float, verdict: str
) -> None:
    seen = {"held_out_fit_percent": reached, "held_out_ceiling_percent": 98.0, "held_out_rms_nm": rms_nm}
    found = judged(model, record, **seen)
    assert found["verdict"] == verdict
    assert ("held-out pulses" in found["words"]) == (rms_nm <= 0.3 or verdict == "not usable")


def test_a_residual_that_is_not_noise_asks_for_care_alone(record: identify.Record, model: identify.Model) -> None:
    assert model.quality["verdict"] == "usable" and model.quality["words"].endswith(" %.")
    grid = make_grid(record)
    alarmed = model.with_(residual_tests={"whiteness": {"passed": False}})
    found = quality(alarmed, grid, grid.fitted)
    assert found["verdict"] == "usable with care"
    assert (
        found["words"] == "Check this before use: the residual is not pure noise (whiteness test): see the diagnosis."
    )

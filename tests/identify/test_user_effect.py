"""docs/add-an-effect.md, run: the file it shows is found, fitted, weighed, written down and read back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from identify.diagnosis import diagnose
from identify.effects import FOLDER_VARIABLE, BadEffect, get, library, registry
from identify.engine import fit_with_effects
from identify.model import Model
from tests.identify import hidden_muscles

PAGE = Path(__file__).parents[2] / "docs" / "add-an-effect.md"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)[0]
    assert len(code.splitlines()) < 40
    assert set(re.findall(r"^(?:import|from) (\S+)", code, re.M)) == {"numpy", "identify.effects.base"}
    (tmp_path / "warming_glove.py").write_text(code)
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    return tmp_path


def _record():
    record = hidden_muscles.record(seed=17, rate_hz=100)
    warm = 1.0 + 0.35 * (1.0 - np.exp(-record.time_s / 18.0))
    return record.with_torque((record.torque_nm - 0.0) * warm)


def test_the_page_s_effect_takes_part_in_everything(folder):
    assert "warming_glove" in registry() and any(row["id"] == "warming_glove" for row in library())
    record = _record()
    model = fit_with_effects(record, ["warming_glove"])
    gain = model.effects[0]["parameters"]["gain"]
    assert abs(gain["value"] - 0.35) < 0.1 and gain["sd"] > 0
    again = Model.from_json(model.to_json())
    np.testing.assert_allclose(again.predict(record), model.predict(record), atol=1e-9)
    result = diagnose(record)
    assert any(c["effect"] == "warming_glove" for c in result["candidates"][0])
    first = result["missing"][0]
    assert "warming_glove" in [first["effect"], *first["confused_with"]]


def test_without_the_folder_it_is_not_there():
    assert "warming_glove" not in registry()


def test_a_broken_file_is_named_in_one_line(folder):
    (folder / "broken.py").write_text("EFFECT = nonsense\n")
    # The registry remembers a folder it has read; a new path is a new folder.
    with pytest.raises(BadEffect, match=r"broken\.py.*NameError"):
        registry()


def test_a_user_s_speed_law_is_neutral_and_acts(folder, tmp_path):
    from identify.effects.base import Form, Parameter
    from identify.engine.prepare import first_setup, inspect
    from identify.engine.problem import Problem

    slope = Parameter("slope", "1", -0.8, 3.0, 0.0, (0.5,))
    form = Form(
        "law", "speed", "T (1 + slope·y)", (slope,), lambda x, p, scene: 1.0 + p["slope"] * x[1] / scene.scale_nm
    )
    record = hidden_muscles.record(seed=18, rate_hz=100)
    setup = first_setup(record, inspect(record))
    base, with_law = Problem(setup, []), Problem(setup, [("mine", form)])
    theta = base.from_physical(np.r_[0.2, 0.9, 0.0, 0.0, np.linspace(0, 6, setup.basis.size)])
    np.testing.assert_array_equal(with_law.run(np.r_[theta, 0.0])[0], base.run(theta)[0])
    builtin = Problem(setup, [("activation_dependent_speed", get("activation_dependent_speed").form("torque"))])
    mine, theirs = with_law.run(np.r_[theta, 0.6])[0], builtin.run(np.r_[theta, 0.6])[0]
    assert np.max(np.abs(mine - theirs)) < 0.05 * np.max(np.abs(theirs - base.run(theta)[0]))

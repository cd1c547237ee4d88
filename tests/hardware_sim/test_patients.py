"""The muscles against closed forms and independent integration, and offline records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

from bench.muscles.offline import simulate
from stimrig.hardware_sim import patients
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients.paper import PaperMuscle
from stimrig.hardware_sim.patients.paper import Parameters as PaperParameters
from tests.harness.muscle import Patient

PERIOD_S = 0.025
PAPER = Patient()
T, ZETA = PAPER.time_constant_s, PAPER.damping


def train(widths_us: np.ndarray) -> np.ndarray:
    return PERIOD_S * np.arange(widths_us.size)


def second_order(held_nm: np.ndarray, damping: float = ZETA) -> np.ndarray:
    """scipy's answer of the paper's muscle to a recruitment, at 1600 Hz."""
    times_s = np.arange(held_nm.size) / 1600
    return lsim(([1], [T**2, 2 * damping * T, 1]), held_nm, times_s, interp=False)[1]


class TestPaper:
    def test_recruitment_is_equation_35(self) -> None:
        widths = np.arange(0.0, 501.0)
        curve = [PaperMuscle().drive_nm(0.0, w, 20.0) for w in widths]
        np.testing.assert_allclose(curve, PAPER.recruitment(widths), atol=1e-12)
        assert PaperMuscle().drive_nm(0.0, 4095.0, 130.0) == pytest.approx(6.8994)

    @pytest.mark.parametrize("damping", [ZETA, 0.3, 1.0, 1.7])
    def test_prbs_against_scipy(self, damping: float) -> None:
        widths = np.repeat(np.random.default_rng(1).integers(0, 2, 40) * 300.0, 4)
        muscle = PaperMuscle(PaperParameters(damping_ratio=damping))
        torque = simulate(muscle, train(widths), widths, 20.0, 1600.0, widths.size * PERIOD_S)
        np.testing.assert_allclose(torque, second_order(np.repeat(PAPER.recruitment(widths), 40), damping), atol=1e-9)

    @pytest.mark.parametrize("jitter_s", [0.0005, 0.004])
    def test_jitter_leaves_no_gap(self, jitter_s: float) -> None:
        widths = np.full(200, 250.0)
        rng = np.random.default_rng(2)
        times = train(widths) + jitter_s * rng.random(widths.size)
        torque = simulate(PaperMuscle(), times, widths, 20.0, 1600.0, 5.0)
        start = times[0]
        t = np.arange(8000) / 1600
        even = simulate(PaperMuscle(), train(widths) + start, widths, 20.0, 1600.0, 5.0)
        late_nm = 6.9 * jitter_s**2 / (2 * T**2)
        assert np.abs(torque - even)[t < times[-1]].max() < 1.5 * late_nm

    def test_a_missing_pulse_gives_zero_from_when_it_was_due(self) -> None:
        widths = np.zeros(100)
        widths[np.random.default_rng(3).choice(80, 60, replace=False)] = 250.0
        sent = widths > 0
        torque = simulate(PaperMuscle(), train(widths)[sent], widths[sent], 20.0, 1600.0, 2.5)
        np.testing.assert_allclose(torque, second_order(np.repeat(PAPER.recruitment(widths), 40)), atol=1e-7)


def test_width_zero_is_no_pulse_and_records_repeat() -> None:
    widths = np.array([300.0, 0.0, 300.0, 0.0])
    for name in patients.PATIENTS:
        first = simulate(patients.make(name), train(widths), widths, 20.0, 1600.0, 0.2)
        sparse = simulate(patients.make(name), train(widths)[::2], widths[::2], 20.0, 1600.0, 0.2)
        np.testing.assert_array_equal(first, sparse)


class TestRegistry:
    def test_file_overrides_by_name(self, tmp_path: Path) -> None:
        path = tmp_path / "patient.toml"
        path.write_text('patient = "paper"\n[parameters]\na1 = 2.0\n')
        muscle = patients.from_file(path)
        assert isinstance(muscle, PaperMuscle)
        assert muscle.drive_nm(0.0, 4000.0, 20.0) == pytest.approx(2.0)

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ('patient = "papr"', "changing, paper"),
            ('patient = "paper"\n[parameters]\na9 = 1.0', "no parameter 'a9'"),
            ('patient = "paper"\n[parameters]\na1 = "x"', "finite number"),
            ('patient = "paper"\n[parameters]\na1 = nan', "finite number"),
            ('patient = "paper"\n[parameters]\nnatural_period_s = 0', "above zero"),
            ("patient = \nx = 1", "line 1"),
            ('patent = "paper"', "unknown key 'patent'"),
            ('patient = "paper"\nparameters = 3', "must be a table"),
            (None, "cannot be read"),
        ],
    )
    def test_bad_files_are_told_with_their_name(self, tmp_path: Path, text: str | None, told: str) -> None:
        path = tmp_path / "patient.toml"
        if text is not None:
            path.write_text(text)
        with pytest.raises(HardwareSimError) as caught:
            patients.from_file(path)
        assert told in str(caught.value)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)

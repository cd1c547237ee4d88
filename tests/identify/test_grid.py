"""The grid of pulses against integration at 8 kHz, at any sampling rate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stimrig.identify.dynamics import grid as pulse_grid
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.second_order import boundary_states
from stimrig.identify.records.record import Record
from tests.harness.patients import Patient, as_record

PULSE_RATE_HZ = 40.0


def schedule(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.r_[np.zeros(20), rng.integers(0, 2, 200) * 300.0, np.linspace(0, 300, 200)]


@pytest.mark.parametrize(("rate_hz", "delay_s"), [(40, 0.0), (50, 0.031), (250, 0.0), (400, 0.031), (2000, 0.031)])
def test_block_means_match_fine_integration(rate_hz: int, delay_s: float) -> None:
    patient, widths_us = Patient(time_constant_s=0.15, damping=0.64, delay_s=delay_s), schedule()
    grid = make_grid(as_record(patient.torque(widths_us, rate_hz), widths_us, rate_hz))
    drive = patient.recruitment(widths_us[: grid.size])
    assert np.array_equal(grid.pulse_width_us, widths_us[: grid.size])
    assert np.abs(SecondOrder(0.15, 0.64, delay_s).on_grid(grid, drive) - grid.torque_nm).max() < 2e-5


def test_a_clock_that_wanders_is_followed_at_a_bounded_price(monkeypatch: pytest.MonkeyPatch) -> None:
    """A real recording has a place of its own for every sample; curves are worked out for some of them."""
    patient = Patient(time_constant_s=0.03, damping=2.0)
    widths_us = schedule()
    torque = patient.torque(widths_us, 1600.0)
    even_s = np.arange(torque.size) / 1600.0
    time_s = even_s + 1e-4 * np.sin(np.arange(torque.size) ** 1.1)
    slot = np.floor(even_s * PULSE_RATE_HZ + 1e-9).astype(int)
    record = Record.from_arrays(time_s, widths_us[slot], torque)
    linear, told = SecondOrder(0.03, 2.0), []
    for most in (pulse_grid.PLACES, 10**9):
        monkeypatch.setattr(pulse_grid, "PLACES", most)
        grid = make_grid(record)
        told.append((len(grid._places[0]), linear.on_grid(grid, patient.recruitment(grid.pulse_width_us))))
    (few, coarse), (many, exact) = told
    assert few <= 1025 < many
    assert np.abs(coarse - exact).max() < 2e-5 * np.ptp(torque)


@pytest.mark.parametrize("skipped", [0, 3])
@pytest.mark.parametrize(("time_constant_s", "damping"), [(0.15, 0.15), (0.03, 1.0), (0.012, 2.0), (0.012, 8.0)])
def test_the_curve_is_exact_however_short_a_lag_is(time_constant_s: float, damping: float, skipped: int) -> None:
    """A second lag of 0.8 ms and more; `skipped` samples leave a first interval unlike the others."""
    patient = Patient(time_constant_s=time_constant_s, damping=damping)
    widths_us = schedule()
    torque = patient.torque(widths_us, 400.0)
    grid = make_grid(as_record(torque, widths_us, 400.0).take(np.arange(torque.size) >= skipped))
    linear = SecondOrder(time_constant_s, damping)
    drive = patient.recruitment(grid.pulse_width_us)
    assert np.abs(linear.on_grid(grid, drive) - grid.torque_nm).max() < 1e-6
    torque_nm, rate_nm_s = boundary_states(linear.core, grid.step_s, drive[None, :])
    at_samples = grid.at_samples(torque_nm[0], rate_nm_s[0], 0.0, grid.curve(linear.core))
    assert np.abs(at_samples - torque[skipped:]).max() < 1e-6


@given(phase=st.floats(0.0, 0.02499), rate_hz=st.sampled_from([100, 200, 400, 1000, 1600]), start_s=st.floats(-5, 500))
@settings(max_examples=60, deadline=None)
def test_the_pulses_are_found_wherever_the_record_starts(phase: float, rate_hz: int, start_s: float) -> None:
    widths_us = schedule(1)
    since = np.arange(int(9 * rate_hz)) / rate_hz
    slot = np.floor((since - phase) * PULSE_RATE_HZ + 1e-9).astype(int) + 1
    record = Record.from_arrays(start_s + since, widths_us[slot], np.zeros(since.size))
    grid = make_grid(record)
    inside = slice(1, -1)  # the first and last interval may be cut short by the record's ends
    first = np.flatnonzero(grid.pulse_width_us)[0] - np.flatnonzero(widths_us)[0]
    expected = widths_us[np.arange(grid.size) - first]
    assert np.array_equal(grid.pulse_width_us[inside], expected[inside])

"""The white noise where a recorder holds, rounds, interpolates or smooths its readings: truth against estimate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from stimrig import identify
from stimrig.identify.estimation.samples import inspect
from stimrig.identify.records.readings import Readings
from stimrig.identify.records.record import Record
from tests.harness import few_effects
from tests.harness.muscle import Patient
from tests.harness.patients import make_record

pytestmark = pytest.mark.slow

SD_NM = 0.08
Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def made(seed: int, rate_hz: float = 400.0, sd_nm: float = SD_NM, change: Change | None = None) -> Record:
    rng = np.random.default_rng(seed)
    record, _ = make_record(Patient(), rng, rate_hz=rate_hz, noise_nm=sd_nm)
    return record if change is None else record.with_torque(change(record.torque_nm, rng))


def held(each: int) -> Change:
    return lambda torque, _rng: torque[np.arange(torque.size) // each * each]


def held_at_random(share: float) -> Change:
    def change(torque: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        new = rng.random(torque.size) > share
        new[0] = True
        return torque[np.maximum.accumulate(np.where(new, np.arange(torque.size), 0))]

    return change


def rounded(count_nm: float) -> Change:
    return lambda torque, _rng: np.round(torque / count_nm) * count_nm


def lines(each: int) -> Change:
    return lambda torque, _rng: np.interp(np.arange(torque.size), np.arange(torque.size)[::each], torque[::each])


def found_in(record: Record) -> tuple[float, Readings]:
    raw = inspect(record)
    assert raw.readings is not None
    return raw.noise_sd_nm, raw.readings


@pytest.mark.parametrize("rate_hz", [40, 400])
def test_an_ordinary_record_has_a_reading_in_each_sample(rate_hz: float):
    record = made(71, rate_hz)
    raw = inspect(record)
    difference = np.diff(raw.torque_nm[~record.held_out], 4 if rate_hz < 120 else 3)
    assert raw.readings is None
    assert raw.noise_sd_nm == np.sqrt(np.median(difference**2) / 0.4549 / (70.0 if rate_hz < 120 else 20.0))
    assert raw.noise_sd_nm == pytest.approx(SD_NM, rel=0.1)


@pytest.mark.parametrize(
    ("rate_hz", "each", "sd_nm"), [(40, 2, 0.1), (100, 5, 0.02), (400, 2, 0.1), (400, 20, 0.02), (1000, 10, 0.02)]
)
def test_the_noise_of_held_readings(rate_hz: float, each: int, sd_nm: float):
    noise_nm, readings = found_in(made(73, rate_hz, sd_nm, held(each)))
    assert readings.kind == "held"
    assert readings.samples_each == pytest.approx(each, rel=0.01)
    # Below 40 readings a second the torque moves between two: an upper bound.
    most = 1.25 if rate_hz / each >= 40 else 1.7
    assert 0.75 < noise_nm / sd_nm < most


def test_readings_held_at_random():
    noise_nm, _ = found_in(made(75, change=held_at_random(0.8)))
    assert noise_nm == pytest.approx(SD_NM, rel=0.12)


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_rounding_is_part_of_the_noise(times: float):
    noise_nm, readings = found_in(made(76, change=rounded(times * SD_NM)))
    assert noise_nm == pytest.approx(np.hypot(SD_NM, times * SD_NM / 12**0.5), rel=0.15)
    assert "counts" in readings.words
    # Without noise a rounded reading is still no better than its count.
    quiet_nm, _ = found_in(made(76, sd_nm=0.0, change=rounded(0.1)))
    assert quiet_nm == pytest.approx(0.1 / 12**0.5, rel=0.3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("rate_hz", [40, 200])
def test_coarse_counts_are_no_clipping(rate_hz: float, sign: float):
    """Of a muscle that holds its largest torque; the same torque with its noise, cut off, is clipped."""
    quick = Patient.with_rise(40.0, 100.0, gain=7.0, time_constant_s=0.1, damping=1.0)
    record, _ = make_record(quick, np.random.default_rng(4), rate_hz=rate_hz, noise_nm=0.03)
    coarse = inspect(record.with_torque(sign * np.round(record.torque_nm / 0.5) * 0.5))
    assert coarse.ceiling_nm is None and coarse.floor_nm is None
    cut = inspect(record.with_torque(sign * np.minimum(np.round(record.torque_nm / 0.01) * 0.01, 5.0)))
    assert (cut.ceiling_nm, cut.floor_nm) == ((5.0, None) if sign > 0 else (None, -5.0))


def test_held_and_coarse():
    noise_nm, readings = found_in(made(77, change=lambda torque, rng: held(5)(rounded(SD_NM)(torque, rng), rng)))
    assert readings.samples_each == 5.0
    assert noise_nm == pytest.approx(np.hypot(SD_NM, SD_NM / 12**0.5), rel=0.12)


@pytest.mark.parametrize(("rate_hz", "each"), [(400, 2), (1000, 10)])
def test_interpolated_readings(rate_hz: float, each: int):
    noise_nm, readings = found_in(made(78, rate_hz, change=lines(each)))
    assert readings.kind == "interpolated"
    assert noise_nm == pytest.approx(SD_NM, rel=0.2)


@pytest.mark.parametrize(("rate_hz", "cut_hz"), [(400, 20), (1000, 50)])
def test_smoothed_noise_is_told(rate_hz: float, cut_hz: float):
    low = np.asarray(butter(2, cut_hz, fs=rate_hz, output="sos"))
    noise_nm, readings = found_in(made(79, rate_hz, change=lambda torque, _rng: np.asarray(sosfilt(low, torque))))
    left = np.std(np.asarray(sosfilt(low, np.random.default_rng(1).standard_normal(100_000) * SD_NM)))
    assert readings.kind == "smoothed"
    assert noise_nm == pytest.approx(left, rel=0.25)


def test_units_sign_offset_and_scale_change_nothing():
    record = made(80, change=held(5))
    first_nm, first = found_in(record)
    for scale, offset in ((-1.0, 0.0), (1.0, 50.0), (0.1, -3.0)):
        again_nm, again = found_in(record.with_torque(scale * record.torque_nm + offset))
        assert again_nm == pytest.approx(abs(scale) * first_nm, rel=1e-6)
        assert np.array_equal(again.at, first.at)


def test_a_white_residual_far_above_the_noise_of_the_samples_is_not_noise():
    """Readings held for two pulses: what that spoils is white, too, and was taken for the noise that it is not."""
    record = made(82, rate_hz=80.0, change=held(4))
    found = identify.fit(record)
    with few_effects.only("fatigue"):  # the noise does not depend on how many are tried
        assert found.fit["noise_sd_nm"] == pytest.approx(identify.diagnose(record).noise_sd_nm, rel=0.25)


def test_a_held_record_has_a_ceiling_and_nothing_missing():
    record = made(81, rate_hz=200.0, change=held(5))
    with few_effects.only("mains_hum", "recruitment_hysteresis"):
        found = identify.diagnose(record)
    assert found.noise_sd_nm == pytest.approx(SD_NM, rel=0.1)
    assert found.verdict == "nothing_missing"
    assert found.with_all["noise_sd_nm"] == pytest.approx(SD_NM, rel=0.1)
    assert found.base["fit_percent"] == pytest.approx(found.base["ceiling_percent"], abs=0.3)
    assert found.notes[0].startswith("The recorder holds each reading for 5 samples")

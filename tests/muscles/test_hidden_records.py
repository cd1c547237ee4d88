"""Records of hidden effects: what is in them, noise, files, and that the seed settles everything."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from bench.muscles.hidden_records import draw_noise, generate, main, write_csv

pytestmark = pytest.mark.slow


def read_csv(path: Path) -> dict[str, list[str]]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def test_the_seed_settles_everything() -> None:
    one, again, other = (generate("fatigue", "middle", seed) for seed in (300, 300, 301))
    assert np.array_equal(one["torque_nm"], again["torque_nm"])
    assert one["truth"] == again["truth"]
    assert one["truth"] != other["truth"]


def test_a_record_is_uniform_and_holds_the_segments_of_its_design() -> None:
    record = generate("catch_like", "weak", 302, rate_hz=400)
    assert np.allclose(np.diff(record["time_s"]), 1.0 / 400.0)
    assert list(dict.fromkeys(record["segment"])) == ["rest", "prbs", "ramp", "validate"]
    held = record["pulse_width_us"].reshape(-1, 10)
    assert np.all(held == held[:, :1])  # 40 pulses a second
    assert "angle_rad" not in record
    assert np.all(record["pulse_width_us"][record["segment"] == "rest"] == 0.0)


@pytest.mark.parametrize("rate_hz", [40, 100, 333, 1600, 2000])
def test_the_rate_changes_the_samples_and_not_the_muscle(rate_hz: float) -> None:
    usual, other = (generate("output_saturation", "strong", 303, rate_hz=rate) for rate in (400, rate_hz))
    assert other["truth"]["parameters"] == usual["truth"]["parameters"]
    assert len(other["time_s"]) == pytest.approx(47.7 * rate_hz, abs=2)
    difference = np.interp(usual["time_s"], other["time_s"], other["torque_nm"]) - usual["torque_nm"]
    assert np.sqrt(np.mean(difference**2)) < 0.1  # two noises of 0.04, and interpolation at 40 Hz


def test_short_designs_and_those_without_held_out_rows() -> None:
    short = generate("fatigue", "middle", 304, design="short")
    assert set(short["segment"]) == {"prbs", "ramp"}
    unheld = generate("fatigue", "middle", 304, with_validate=False)
    assert set(unheld["segment"]) == {"rest", "prbs", "ramp"}
    assert unheld["truth"]["excess"]["fatigue"]["counted_nm"] >= 5 * 0.04


def test_noise_is_what_it_says() -> None:
    rng = np.random.default_rng(9)
    white = draw_noise("white", rng, 200_000, 400, 0.04, 0.9)
    coloured = draw_noise("ar1", rng, 400_000, 400, 0.04, 0.9)
    slow = draw_noise("slow", rng, 400_000, 400, 0.04, 0.9)
    assert white.std() == pytest.approx(0.04, rel=0.02)
    assert coloured.std() == pytest.approx(0.04, rel=0.05)
    assert np.corrcoef(coloured[:-10], coloured[10:])[0, 1] == pytest.approx(0.9, abs=0.02)
    assert slow.std() == pytest.approx(0.04 * np.sqrt(2), rel=0.03)
    assert np.corrcoef(slow[:-30], slow[30:])[0, 1] == pytest.approx(0.5 / np.e, abs=0.03)


def test_a_record_without_effect_has_only_its_noise() -> None:
    record = generate(None, seed=305)
    rest = record["torque_nm"][:800]
    assert rest.std() == pytest.approx(0.04, rel=0.1)
    assert record["truth"]["effects"] == []
    assert not record["truth"]["outside_library"]


def test_a_clipped_sensor_gives_equal_maxima_in_spite_of_noise() -> None:
    record = generate("sensor_clipping", "strong", 306)
    assert np.sum(record["torque_nm"] == record["torque_nm"].max()) > 100
    plain = generate(None, seed=306)
    assert np.sum(plain["torque_nm"] == plain["torque_nm"].max()) == 1


def test_two_at_once_each_of_its_own_strength() -> None:
    record = generate(["fatigue", "mains_hum"], "middle", 307)
    assert record["truth"]["effects"] == ["fatigue", "mains_hum"]
    first, second = record["truth"]["excess_over_noise"]
    assert 5.0 <= min(first, second) <= max(first, second) <= 10.0


def test_a_patient_comes_again_after_a_pause_that_is_not_recorded() -> None:
    once, twice = (generate("fatigue", "middle", 313, rate_hz=100, again_after_s=s) for s in (None, 60.0))
    size = once["time_s"].size
    assert twice["truth"] == once["truth"]
    assert twice["time_s"].size == 2 * size
    for name in ("time_s", "pulse_width_us", "segment"):
        assert np.array_equal(twice[name][:size], once[name])
    assert np.abs(twice["torque_nm"][:size] - once["torque_nm"]).max() < 0.5  # noises of 0.04
    assert twice["time_s"][size] - twice["time_s"][size - 1] == pytest.approx(60.01)
    assert np.array_equal(twice["segment"][size:], once["segment"])
    assert not np.array_equal(twice["pulse_width_us"][size:], once["pulse_width_us"])


@pytest.mark.parametrize("effect", ["threshold_drift", "torque_angle"])
def test_csv_round_trip(effect: str, tmp_path: Path) -> None:
    record = generate(effect, "middle", 309, rate_hz=100)
    write_csv(record, tmp_path / "record.csv")
    columns = read_csv(tmp_path / "record.csv")
    names = ["time_s", "pulse_width_us", "torque_nm", "segment"]
    names += ["angle_rad", "velocity_rad_s"] if effect == "torque_angle" else []
    assert list(columns) == names
    for name in names:
        if name == "segment":
            assert columns[name] == record[name].tolist()
        else:
            assert np.abs(np.array(columns[name], dtype=float) - record[name]).max() < 1e-6
    assert np.isnan(record["torque_nm"]).sum() == 0


def test_command_line_writes_records_and_the_truth(tmp_path: Path) -> None:
    arguments = ["--out", str(tmp_path), "--seeds", "310:312", "--effects", "fatigue,none,pairs", "--strengths", "weak"]
    assert main([*arguments, "--rate-hz", "100"]) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert sorted(truth) == sorted(path.name for path in tmp_path.glob("*.csv"))
    assert len(truth) == 6
    assert truth["fatigue-weak-310.csv"]["effects"] == ["fatigue"]
    assert len(truth["pairs-weak-311.csv"]["effects"]) == 2


def test_bad_settings_are_refused_with_a_word_on_what_there_is() -> None:
    for settings, word in [
        ({"effect": "gremlins"}, "fatigue"),
        ({"effect": "fatigue", "strength": "huge"}, "middle"),
        ({"effect": None, "design": "endless"}, "full"),
        ({"effect": None, "noise": "pink"}, "ar1"),
        ({"effect": None, "rate_hz": 3.0}, "40"),
    ]:
        with pytest.raises(ValueError, match=word):
            generate(**settings)

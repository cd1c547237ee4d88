"""Pulses that came late, were lost or are doubted: what the reader makes of them, and what the fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.criticism import compare
from stimrig.identify.criticism.correlation import correlation_tests
from stimrig.identify.dynamics.grid import Grid, make_grid
from stimrig.identify.methods import methods
from stimrig.identify.problem.predict import predict
from stimrig.identify.records import read
from stimrig.identify.records.record import OPTIONAL, Record
from tests.harness.muscle import FINE_HZ, Patient, second_order
from tests.harness.patients import make_record, protocol

PULSE_S = 0.025
FINE = round(FINE_HZ * PULSE_S)
LAG_S = 0.004
QUICK = Patient(time_constant_s=0.15)
"""Fast enough to show single pulses that came late."""


# ---- simulation ---------------------------------------------------------------------------------------------


def late_pulses(widths_us: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A busy host: 5 % late, those due until 0.6 intervals later dropped, as by the rig; widths, lateness, dropped."""
    widths, late = widths_us.copy(), np.zeros(widths_us.size)
    for k in np.flatnonzero(rng.random(widths.size) < 0.05):
        if widths[k] > 0:
            late[k] = rng.uniform(0.002, 0.06)
            widths[k + 1 : k + 1 + int(late[k] / PULSE_S + 0.6)] = 0.0
    late[widths == 0] = 0.0
    return widths, late, (widths == 0) & (widths_us > 0)


def torque_of(widths_us: np.ndarray, late_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """Clean torque at `rate_hz`, at 8 kHz: each pulse acts for one interval from when it is felt, and they add up."""
    drive, effect = np.zeros((widths_us.size + 6) * FINE), QUICK.recruitment(widths_us)
    felt = np.arange(widths_us.size) * FINE + np.round(late_s * FINE_HZ).astype(int)
    for k in np.flatnonzero(widths_us > 0):
        drive[felt[k] : felt[k] + FINE] += effect[k]
    torque = second_order(drive[: widths_us.size * FINE], QUICK.time_constant_s, QUICK.damping, FINE_HZ)
    return torque[:: round(FINE_HZ / rate_hz)]


def seal(
    path: Path,
    *,
    rate_hz: float = 400.0,
    noise_nm: float = 0.02,
    seed: int = 0,
    sync: bool = True,
    late: bool = True,
    ack_late: dict[int, float] | None = None,
    status_of: dict[int, int] | None = None,
) -> dict[str, np.ndarray]:
    """A recording as docs/recording.md lays it out, written apart from the rig; and what is true of it."""
    rng = np.random.default_rng(seed)
    planned_us, names = protocol(rng)
    nothing = planned_us, np.zeros(planned_us.size), np.zeros(planned_us.size, bool)
    widths, late_s, dropped = late_pulses(planned_us, rng) if late else nothing
    clean = torque_of(widths, late_s, rate_hz)
    planned = np.arange(widths.size) * PULSE_S
    felt = planned + LAG_S + late_s
    status = np.where(dropped, 2, np.where(widths > 0, 0, 1)).astype(np.uint8)
    written = np.where(status == 0, planned + LAG_S + np.minimum(late_s, 0.009), np.nan)
    acknowledged = felt + 0.003
    for pulse, by_s in (ack_late or {}).items():
        acknowledged[pulse] += by_s
    for pulse, code in (status_of or {}).items():
        status[pulse] = code
    acknowledged[status != 0] = np.nan
    time_s = np.arange(clean.size) / rate_hz + LAG_S
    line = np.zeros(clean.size, np.uint8)
    line[np.clip(np.searchsorted(time_s, felt[widths > 0] - 1e-9), 0, line.size - 1)] = 1
    starts = np.flatnonzero(np.r_[True, np.array(names[1:]) != np.array(names[:-1])])
    with h5py.File(path, "w") as file:
        file.attrs.update(format="stimrig-recording", format_version=1, recording_id="r", content_sha256="ab")
        file["/torque/time_s"] = time_s
        file["/torque/torque_nm"] = clean + noise_nm * rng.standard_normal(clean.size)
        file["/torque/sync"] = line if sync else np.full(clean.size, 255, np.uint8)
        file["/pulses/planned_time_s"] = planned
        file["/pulses/sent_pulse_width_us"] = np.where(dropped, np.nan, widths)
        file["/pulses/written_time_s"] = written
        file["/pulses/acknowledged_time_s"] = acknowledged
        file["/pulses/status"] = status
        file["/segments/name"] = [names[k] for k in starts]
        file["/segments/start_s"] = starts * PULSE_S
        file["/segments/end_s"] = np.r_[starts[1:], len(names)] * PULSE_S + np.r_[np.zeros(len(starts) - 1), 0.1]
    return {"widths": widths, "late_s": late_s, "clean": clean, "dropped": dropped, "time_s": time_s}


def cut(path: Path, rows: np.ndarray) -> None:
    """Leave only these samples in a recording."""
    with h5py.File(path, "a") as file:
        for name in ("time_s", "torque_nm", "sync"):
            kept = file[f"/torque/{name}"][:][rows]
            del file[f"/torque/{name}"]
            file[f"/torque/{name}"] = kept


def as_if_punctual(record: Record) -> Record:
    """The record of a reader that takes all pulses for punctual."""
    return replace(record, late_s=None, doubted=None, pulses=None)


def error_over(record: Record, noise_nm: float, **options: object) -> float:
    residual = record.torque_nm - predict(identify.fit(record, **options), record)  # type: ignore[arg-type]
    return float(np.sqrt(np.mean(residual**2))) / noise_nm


# ---- reading ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [400.0, 1600.0])
def test_the_sync_line_tells_when_each_pulse_was_felt(tmp_path, rate_hz):
    true = seal(tmp_path / "r.h5", rate_hz=rate_hz)
    record = read(tmp_path / "r.h5")
    assert record.doubted is None
    assert record.pulses is not None
    assert np.array_equal(record.pulses.lost, true["dropped"])
    assert np.array_equal(record.pulses.width_us, true["widths"])
    assert np.abs(record.pulses.late_s - true["late_s"]).max() < 1.0 / rate_hz + 1.1e-3
    grid = make_grid(record)
    assert grid.late_s is not None
    assert np.array_equal(grid.late_s, record.pulses.late_s[: grid.size])
    assert np.array_equal(grid.pulse_width_us, true["widths"][: grid.size])


def test_without_a_sync_line_the_middle_is_taken_and_a_late_acknowledgement_doubted(tmp_path):
    base = seal(tmp_path / "r.h5", late=False)
    on = np.flatnonzero(base["widths"])
    slow, far = int(on[40]), int(on[200])
    seal(tmp_path / "r.h5", late=False, sync=False, ack_late={slow: 0.008, far: 0.06})
    record = read(tmp_path / "r.h5")
    assert record.pulses is not None
    assert record.pulses.late_s[slow] == pytest.approx(0.004, abs=1e-4)
    assert np.count_nonzero(record.pulses.late_s) == 2
    assert record.doubted is not None
    felt_s = far * PULSE_S + 0.004
    inside = (record.time_s > felt_s - 1e-6) & (record.time_s < felt_s + 0.063 + 1.5 + 1e-6)
    assert np.array_equal(record.doubted, inside)
    seal(tmp_path / "r.h5", late=False, sync=True, ack_late={slow: 0.008, far: 0.06})
    record = read(tmp_path / "r.h5")
    assert record.late_s is None and record.doubted is None  # the line shows that they were felt in time


@pytest.mark.parametrize("code", [4, 5])
def test_a_pulse_of_unknown_fate_is_doubted(tmp_path, code):
    on = np.flatnonzero(seal(tmp_path / "r.h5", late=False)["widths"])
    seal(tmp_path / "r.h5", late=False, sync=False, status_of={int(on[50]): code})
    record = read(tmp_path / "r.h5")
    assert record.doubted is not None
    assert np.sum(record.doubted) / 400 == pytest.approx(1.5, abs=0.01)
    assert not make_grid(record).fitted[int(on[50]) + 1]
    assert make_grid(record).fitted[int(on[50]) - 1]


def test_what_the_sync_line_does_not_show_or_shows_too_often_is_doubted(tmp_path):
    true = seal(tmp_path / "r.h5", late=False)
    pulse = int(np.flatnonzero(true["widths"])[60])
    with h5py.File(tmp_path / "r.h5", "a") as file:
        line = file["/torque/sync"][:]
        line[pulse * 10] = 0
        line[40 * 10 - 200] = 1  # while nothing was sent
        file["/torque/sync"][:] = line
    record = read(tmp_path / "r.h5")
    assert record.doubted is not None
    starts = record.time_s[np.flatnonzero(np.diff(record.doubted.astype(int)) == 1) + 1]
    assert starts == pytest.approx([0.5 + 0.004, pulse * PULSE_S + 0.004], abs=3e-3)


@pytest.mark.parametrize("break_", ["empty", "noise", "inverted"])
def test_a_sync_line_that_means_something_else_is_not_believed(tmp_path, break_):
    seal(tmp_path / "r.h5", late=False)
    with h5py.File(tmp_path / "r.h5", "a") as file:
        line = file["/torque/sync"][:]
        rng = np.random.default_rng(0)
        line[:] = {"empty": 0 * line, "noise": rng.integers(0, 2, line.size), "inverted": 1 - line}[break_]
        if break_ == "inverted":
            line[:] = np.roll(line, 3)
        file["/torque/sync"][:] = line
    record = read(tmp_path / "r.h5")
    assert record.doubted is None
    assert record.late_s is None or np.abs(record.late_s).max() < 2.6e-3


def test_a_gap_in_a_sealed_recording_invents_no_pulse(tmp_path):
    true = seal(tmp_path / "r.h5", late=False)
    rows = np.ones(true["clean"].size, bool)
    # From where the pulses are on to where they are off again, and the other way round.
    steps = np.diff(true["widths"])
    ends = [int(k) for k in np.flatnonzero(steps < -200)[[2, 5]]] + [int(np.flatnonzero(steps > 200)[8])]
    for k in ends:
        rows[10 * k - 40 : 10 * k + 120] = False
    cut(tmp_path / "r.h5", rows)
    record = read(tmp_path / "r.h5")
    assert record.doubted is None
    grid = make_grid(record)
    assert (grid.count == 0).sum() >= 3 * 14
    assert np.array_equal(grid.pulse_width_us, true["widths"][: grid.size])
    # A record that does not know its pulses holds the last width, and begins anew after it.
    blind = make_grid(as_if_punctual(record))
    assert not np.array_equal(blind.pulse_width_us, true["widths"][: grid.size])
    assert blind.resumed.size == len(ends) and grid.resumed.size == 0
    assert all(blind.doubted[k + 1 : k + 20].all() for k in ends)
    assert not blind.doubted[: min(ends) - 5].any()


def test_a_gap_between_rests_is_a_pause_unless_the_torque_moved():
    """A part of a test may have been cut out there: the muscle is still letting go."""
    time_s = np.r_[np.arange(400) / 400, 5 + np.arange(800) / 400]
    width = np.where((np.arange(1200) > 900) & (np.arange(1200) < 1000), 200.0, 0.0)
    torque = np.where(width > 0, 5.0, 0.0)
    assert not make_grid(Record.from_arrays(time_s, width, torque)).doubted.any()
    letting_go = torque + np.where(time_s >= 5, 3.0 * np.exp(-(time_s - 5) / 0.3), 0.0)
    grid = make_grid(Record.from_arrays(time_s, width, letting_go))
    assert grid.starts.tolist() == [0, 200] and grid.doubted[40:208].all()


# ---- the record ---------------------------------------------------------------------------------------------


def test_a_record_loses_no_column_when_rows_are_taken():
    columns = {name: np.arange(40) % 2 if name == "doubted" else np.arange(40) / 100 for name in OPTIONAL}
    record = Record.from_arrays(np.arange(40) / 40, np.zeros(40), np.zeros(40), **columns)
    assert tuple(record.columns()) == OPTIONAL
    part = record.take(np.arange(10, 20))
    for name in OPTIONAL:
        assert np.array_equal(part.columns()[name], record.columns()[name][10:20])
    assert record.with_torque(np.ones(40)).columns().keys() == record.columns().keys()


@pytest.mark.parametrize(
    ("column", "values", "says"),
    [
        ("late_s", np.zeros(5), r"late_s: late_s has shape \(5,\), time_s has \(40,\)"),
        ("late_s", np.r_[np.zeros(39), np.nan], "late_s, sample 39: not finite"),
        ("doubted", np.r_[0.5, np.zeros(39)], "doubted, sample 0: 0.5 is neither 0 nor 1"),
        ("angle_rad", np.full(40, np.inf), "angle_rad, sample 0: not finite"),
    ],
)
def test_bad_columns_are_one_line(column, values, says):
    with pytest.raises(identify.BadRecord, match=says) as caught:
        Record.from_arrays(np.arange(40) / 40, np.zeros(40), np.zeros(40), **{column: values})
    assert "\n" not in str(caught.value)


# ---- held ---------------------------------------------------------------------------------------------------


def grid_of(late: dict[int, float], widths: np.ndarray | None = None) -> Grid:
    """Forty intervals, all with pulses unless told; lateness in intervals."""
    widths = np.full(40, 100.0) if widths is None else widths
    late_s = np.zeros(40)
    for k, part in late.items():
        late_s[k] = part * PULSE_S
    return make_grid(Record.from_arrays(np.arange(40) / 40, widths, np.zeros(40), late_s=late_s))


def test_held_leaves_the_drive_before_standing():
    drive = np.random.default_rng(0).random((40, 3))
    held = grid_of({10: 0.15, 20: -0.1}).interval_means(drive)
    assert held[10] == pytest.approx(0.85 * drive[10] + 0.15 * drive[9])
    assert held[19] == pytest.approx(0.9 * drive[19] + 0.1 * drive[20])
    rest = np.delete(np.arange(40), [10, 19])
    assert np.array_equal(held[rest], drive[rest])
    assert np.array_equal(grid_of({10: 0.15, 20: -0.1}).interval_means(drive.T, axis=1), held.T)
    assert np.array_equal(grid_of({10: 0.15, 20: -0.1}).interval_means(drive[:, 1]), held[:, 1])


def test_a_pulse_that_is_later_acts_whole_but_later():
    drive = np.random.default_rng(0).random(40)
    held = grid_of({10: 0.4, 20: 1.3}).interval_means(drive)
    assert held[10] == pytest.approx(0.6 * drive[10])
    assert held[11] == pytest.approx(drive[11] + 0.4 * drive[10])
    assert held[20] == 0.0
    assert held[21:23] == pytest.approx(drive[21:23] + np.array([0.7, 0.3]) * drive[20])


# ---- fitting ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sync", [True, False])
def test_lateness_that_is_known_is_no_error(tmp_path, sync):
    """5 % of the pulses up to 60 ms late, those due meanwhile dropped."""
    noise_nm = 0.03
    true = seal(tmp_path / "r.h5", rate_hz=400, noise_nm=noise_nm, sync=True, seed=1)
    record = read(tmp_path / "r.h5")
    if not sync:  # as somebody would write it in a CSV file
        late_s = np.repeat(true["late_s"], 10)[: record.time_s.size]
        record = replace(as_if_punctual(record), late_s=late_s)
    assert error_over(as_if_punctual(record), noise_nm) >= 1.3
    assert error_over(record, noise_nm) <= 1.1


@pytest.mark.parametrize("method", sorted(methods()))
def test_every_method_predicts_what_was_felt(method):
    record, _ = make_record(QUICK, np.random.default_rng(0), rate_hz=80, noise_nm=0.02)
    model = identify.fit(record, method=method)
    late_s = np.zeros(record.time_s.size)
    on = np.flatnonzero(record.pulse_width_us[::2] > 100)[5::20] * 2
    for k in on:
        late_s[k : k + 2] = 0.015
    late = replace(record, late_s=late_s)
    change = np.abs(predict(model, late) - predict(model, record))
    assert change.max() > 5e-3
    assert np.all(change[: on[0] - 6] < 1e-12)
    # And it is fitted so: with the lateness known it says something else than without.
    other = identify.fit(late, method=method)
    assert np.abs(predict(other, late) - predict(model, late)).max() > 1e-4


def test_what_is_doubted_is_not_counted():
    record, _ = make_record(QUICK, np.random.default_rng(2), rate_hz=200, noise_nm=0.02)
    doubted = np.zeros(record.time_s.size, bool)
    names = np.array(record.segment_names)[record.segment]
    for name in ("prbs", "validate"):
        first = int(np.flatnonzero(names == name)[0]) + 400
        doubted[first : first + 300] = True
    torque = np.where(doubted, record.torque_nm + 3.0, record.torque_nm)
    wrong = replace(record.with_torque(torque), doubted=doubted)
    model, clean = identify.fit(wrong), identify.fit(record)
    assert model.linear.time_constant_s == pytest.approx(clean.linear.time_constant_s, rel=5e-3)
    assert model.fit["held_out_rms_nm"] == pytest.approx(clean.fit["held_out_rms_nm"], rel=0.1)
    assert max(part["rms_nm"] for part in model.fit["segments"]) < 0.03
    against = compare(model, wrong)
    assert against.rms_nm < 0.025
    assert against.held_out["rms_nm"] < 0.025
    assert all(row["rms_nm"] is None or row["rms_nm"] < 0.05 for rows in against.by.values() for row in rows)
    assert against.left_out == "3.0 s are left out: the stimulation there is not known."
    assert against.left_out in against.plain
    assert compare(clean, record).left_out == ""


def test_it_is_said_how_much_was_left_out(tmp_path):
    true = seal(tmp_path / "r.h5", seed=1)
    record = read(tmp_path / "r.h5")
    words = compare(identify.fit(record), record).left_out
    late = int(np.sum(true["late_s"] > 0.005)) + int(np.sum(true["dropped"]))
    said = int(words.split()[0])
    assert abs(said - late) <= 3
    assert "pulses were felt 5 ms late or more, or lost" in words
    assert words.endswith("; the time of each is known, so nothing is left out.")


def test_a_record_of_nothing_but_doubt_is_refused():
    record, _ = make_record(QUICK, np.random.default_rng(2), rate_hz=80)
    model = identify.fit(record)
    blind = replace(record, doubted=np.ones(record.time_s.size, bool))
    with pytest.raises(identify.IdentifyError, match="fewer than 26 pulse intervals are known"):
        compare(model, blind)
    with pytest.raises(identify.IdentifyError, match="may be fitted"):
        identify.fit(blind)


def test_correlations_are_taken_with_what_was_felt():
    rng = np.random.default_rng(4)
    widths, late_s, _ = late_pulses(rng.uniform(0.0, 300.0, 1200), rng)
    record = Record.from_arrays(np.arange(1200) / 40, widths, np.zeros(1200), late_s=late_s)
    grid = make_grid(record)
    error_nm = grid.interval_means(widths)[grid.interval]
    found = {
        test["with"]: test for test in correlation_tests(grid, error_nm, grid.fitted, np.zeros((grid.size, 0)))["tests"]
    }
    assert found["u"]["values"][0] == pytest.approx(1.0)
    assert not found["u"]["passed"]

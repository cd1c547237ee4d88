"""Joining: either order is the same record, each part keeps what is its own, and a file gives all of it back."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify import Record
from stimrig.identify.dynamics.grid import Grid, make_grid, runs
from stimrig.identify.errors import BadRecord
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.records.join import PAUSE_S, join, write_joined
from stimrig.identify.records.record import Part, Pulses, Source
from tests.harness.patients import Patient, make_record


def record(
    rate_hz: float, lag_s: float = 0.0, *, offset_nm: float = 0.0, working: bool = False, name: str = "a", seed: int = 1
) -> Record:
    """Six seconds: rest (unless working), steps, validate; a pulse is due `lag_s` after the first sample."""
    time_s = np.arange(round(6.0 * rate_hz)) / rate_hz
    slot = np.floor((time_s - lag_s) * 40 + 1e-6)
    width = np.where((slot >= (-1 if working else 40)) & (slot // 20 % 2 == 0), 200.0, 50.0 if working else 0.0)
    names = np.where(slot < 40, "rest", np.where(slot < 200, "steps", "validate"))
    torque = offset_nm + width / 40 + 0.01 * np.random.default_rng(seed).normal(size=time_s.size)
    source = Source(f"{name}.h5", f"20260101T000000Z_{name}", name * 64)
    return Record.from_arrays(time_s, width, torque, names, source=source)


def same(one: Record, other: Record, *, but: tuple[str, ...] = ()) -> bool:
    """Whether all fields are equal to the last bit."""
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        if isinstance(getattr(one, field.name), np.ndarray)
        else getattr(one, field.name) == getattr(other, field.name)
        for field in fields(Record)
        if field.name not in but
    )


def through_file(joined: Record, folder: Path) -> Record:
    path = folder / "joined.csv"
    write_joined(joined, path)
    return identify.read(path)


def test_the_same_measurement_twice_is_refused_under_any_name(tmp_path):
    a, b = record(400), record(400, name="b", seed=2)
    copy = replace(a, source=Source("copy.h5", "20260101T000000Z_copy", "c" * 64))
    with pytest.raises(BadRecord, match=r"recording 2: what it holds was measured in another"):
        join([a, copy], [0.0, 100.0])
    whole = join([a, b], [0.0, 100.0])
    for again in (whole, through_file(whole, tmp_path)):
        with pytest.raises(BadRecord, match=r"recording 3: "):
            join([record(400, name="d", seed=4), b, again], [500.0, 100.0, None])


@pytest.mark.parametrize("rates", [(400, 400), (1000, 400)])
def test_either_order_gives_the_same_record(rates):
    a, b = record(rates[0], 0.01), record(rates[1], 0.004, name="b", seed=2)
    joined = join([a, b], [1000.0, 1067.0])
    assert same(joined, join([b, a], [1067.0, 1000.0]))
    assert [source.recording_id[-1] for source in joined.source.parts] == ["a", "b"]
    assert same(join([a, b], [5.0, 5.0]), join([b, a], [5.0, 5.0]))


def test_as_given_where_a_begin_is_not_known():
    a, b = record(400), record(400, name="b", seed=2)
    joined = join([b, a], [None, 0.0])
    assert [source.name for source in joined.source.parts] == ["b.h5", "a.h5"]
    assert [part.pause_s for part in joined.parts] == [0.0, 0.0]


def test_parts_of_one_rate_keep_every_sample_with_its_offset():
    a, b = record(400, 0.01, offset_nm=0.3), record(400, 0.0175, offset_nm=-0.2, name="b", seed=2)
    joined = join([a, b], [0.0, 20.0])
    assert np.array_equal(joined.torque_nm, np.r_[a.torque_nm, b.torque_nm])
    assert np.array_equal(joined.pulse_width_us, np.r_[a.pulse_width_us, b.pulse_width_us])
    assert np.array_equal(joined.time_s[: a.time_s.size], a.time_s)
    assert np.array_equal(np.bincount(joined.part), [a.time_s.size, b.time_s.size])
    assert joined.segment_names == ("rest", "steps", "validate") * 2
    assert [part.first for part in joined.parts] == [0, a.time_s.size]


@pytest.mark.parametrize(("rates", "working"), [((400, 500), False), ((1600, 400), False), ((400, 1600), True)])
def test_pulses_of_all_parts_fall_on_one_grid(rates, working):
    """Every interval of the grid has one width, and it is the one that was in force."""
    a, b = record(rates[0], 0.01), record(rates[1], 0.02, working=working, name="b", seed=2)
    joined = join([a, b], [0.0, 20.0])
    grid = make_grid(joined)
    lowest, highest = (np.full(grid.size, start) for start in (np.inf, -np.inf))
    np.minimum.at(lowest, grid.interval, joined.pulse_width_us)
    np.maximum.at(highest, grid.interval, joined.pulse_width_us)
    assert np.array_equal(lowest[grid.count > 0], highest[grid.count > 0])
    # Torque follows the width at once here: a part out of phase would show in the means over the intervals.
    known = grid.fitted
    assert np.abs(grid.torque_nm - grid.pulse_width_us / 40)[known].max() < 0.05
    for part in (0, 1):
        own = make_grid((a, b)[part])
        rows = grid.count * (grid.part == part) > 0
        assert abs(rows.sum() - own.size) <= 1


def test_faster_part_is_brought_down_by_means_in_place():
    slow, fast = record(400, 0.0), record(1600, 0.0, name="b", seed=2)
    line = fast.with_torque(0.5 + 0.1 * fast.time_s)
    joined = join([slow, line], [0.0, 10.0])
    assert joined.sample_rate_hz == pytest.approx(400, rel=1e-6)
    rows = joined.part == 1
    own_s = joined.time_s[rows] - joined.time_s[rows][0] + joined.parts[1].own_s
    assert np.allclose(joined.torque_nm[rows], 0.5 + 0.1 * own_s, atol=1e-9)  # the mean at its mean time
    noise = [np.diff(joined.torque_nm[joined.part == 0][:300]).std(), np.diff(fast.torque_nm[:1200]).std()]
    mean = join([slow, fast], [0.0, 10.0])
    assert np.diff(mean.torque_nm[mean.part == 1][:300]).std() == pytest.approx(noise[1] / 2, rel=0.15)
    assert noise[0] == pytest.approx(noise[1], rel=0.15)


def test_rates_of_two_clocks_stay_as_they_are():
    a, b = record(1600), record(1600, name="b", seed=2)
    drifted = replace(b, time_s=b.time_s * 1.0004)
    assert join([a, drifted], [0.0, 10.0]).time_s.size == a.time_s.size + b.time_s.size


@pytest.mark.parametrize(("pause_s", "kept_s"), [(5.0, 5.0), (61.0, PAUSE_S), (7200.0, PAUSE_S), (1e6, PAUSE_S)])
def test_each_pause_is_kept_and_a_long_one_folded(pause_s, kept_s):
    a, b = record(400, 0.01), record(400, 0.01, name="b", seed=2)
    joined = join([a, b], [1000.0, 1000.0 + 6.0 + pause_s])
    part = joined.parts[1]
    assert part.pause_s == pytest.approx(min(pause_s, 86400.0), abs=0.025)
    assert part.folded_s == pytest.approx(kept_s, abs=0.025)
    assert part.begun_s == 1000.0 + 6.0 + pause_s
    assert part.pause_s * 40 == pytest.approx(round(part.pause_s * 40))
    jump = joined.time_s[part.first] - joined.time_s[part.first - 1]
    assert jump == pytest.approx(kept_s, abs=0.03)
    grid = make_grid(joined)
    # Empty intervals are the pause, belong to the part before it, and nothing is stimulated in them.
    assert (grid.count == 0).sum() == round(part.folded_s * 40)
    assert not grid.part[grid.count == 0].any()
    assert not grid.pulse_width_us[grid.count == 0].any()
    assert not any(set(grid.part[run]) == {0, 1} for run in grid.stretches(grid.fitted))


def test_parts_whose_clocks_overlap_have_no_pause():
    joined = join([record(400), record(400, name="b", seed=2)], [0.0, 3.0])
    assert joined.parts[1].pause_s == joined.parts[1].folded_s == 0.0
    assert (np.diff(joined.time_s) > 0).all()
    assert not any(
        set(make_grid(joined).part[run]) == {0, 1} for run in make_grid(joined).stretches(make_grid(joined).fitted)
    )


def test_noise_is_not_carried_from_one_part_into_the_next():
    """Parts that lie back to back, with nothing held out between them, are still two stretches of noise."""
    whole = record(400)
    one = whole.take(~whole.held_out)
    joined = join([one, replace(one, torque_nm=one.torque_nm[::-1] * 0.5)], [0.0, 3.0])
    grid = make_grid(joined)
    assert [set(grid.part[run]) for run in runs(grid.fitted)] == [{0, 1}]
    setup = fit_plain(*_rows(joined)).problem.setup
    start, stop = setup.stretches
    assert [set(grid.part[a:b]) for a, b in zip(start, stop, strict=True)] == [{0}, {1}]


def _rows(joined: Record) -> tuple[Grid, np.ndarray]:
    grid = prepare(joined)[0]
    return grid, grid.fitted


def test_held_out_rows_stay_held_out():
    a, b = record(400), record(1600, name="b", seed=2)
    joined = join([a, b], [0.0, 50.0])
    assert joined.held_out[joined.part == 0].sum() == a.held_out.sum() > 0
    assert joined.held_out[joined.part == 1].sum() == pytest.approx(b.held_out.sum() / 4, abs=1)


def test_optional_columns_are_kept_where_all_parts_have_them():
    a, b = (record(rate, name=name) for rate, name in ((400, "a"), (1600, "b")))
    a, b = (replace(each, angle_rad=1 + 0.1 * each.time_s, velocity_rad_s=0 * each.time_s + 0.1) for each in (a, b))
    joined = join([a, b], [0.0, 50.0])
    assert joined.angle_rad is not None and joined.velocity_rad_s is not None
    assert joined.angle_rad.shape == joined.time_s.shape and np.isfinite(joined.angle_rad).all()
    assert joined.velocity_rad_s == pytest.approx(0.1)
    dropped = join([a, replace(b, angle_rad=None)], [0.0, 50.0])
    assert dropped.angle_rad is None and dropped.velocity_rad_s is not None


def test_lateness_and_doubt_of_one_part_stay_its_own(tmp_path):
    a, b = record(400, name="a"), record(1600, name="b", seed=2)
    late = np.where((b.time_s >= 2) & (b.time_s < 2.025), 0.004, 0.0)
    joined = join([a, replace(b, late_s=late, doubted=b.time_s >= 5)], [0.0, 50.0])
    for each in (joined, through_file(joined, tmp_path)):
        assert each.late_s is not None and each.doubted is not None and each.doubted.dtype == bool
        assert not each.late_s[each.part == 0].any() and not each.doubted[each.part == 0].any()
        assert (each.late_s == 0.004).sum() == 10 and each.doubted.sum() == 400
    assert join([a, b], [0.0, 50.0]).late_s is None


@pytest.mark.parametrize("known", [True, False])
def test_gap_is_told_by_the_pulses_or_doubted_to_the_end_of_its_part(known):
    def with_gap(name: str, seed: int) -> Record:
        whole = record(400, name=name, seed=seed)
        slots = slice(None, None, 10)
        pulses = Pulses(whole.time_s[slots], whole.pulse_width_us[slots], np.zeros(240), np.zeros(240, bool))
        return replace(whole, pulses=pulses if known else None).take((whole.time_s < 4.9) | (whole.time_s >= 5.3))

    a, b = with_gap("a", 1), with_gap("b", 2)
    joined = join([a, b], [0.0, 9.0])
    grid = make_grid(joined)
    own = make_grid(a)
    for part in (0, 1):
        rows = np.flatnonzero(grid.part == part)[: own.size]
        assert np.array_equal(grid.pulse_width_us[rows], own.pulse_width_us)
        assert np.array_equal(grid.doubted[rows], own.doubted)
    assert grid.doubted.any() == (not known)


def test_parts_of_some_rows():
    a, b, c = (record(400, name=name, seed=seed) for seed, name in enumerate("abc"))
    joined = join([a, b, c], [0.0, 16.0, 116.0])
    some = joined.take((joined.part != 1) & (np.arange(joined.time_s.size) > 9))
    assert [part.first for part in some.parts] == [0, a.time_s.size - 10]
    assert some.parts[0].own_s == pytest.approx(a.time_s[10])
    assert some.parts[1].pause_s == pytest.approx(104.0, abs=0.06)
    assert some.parts[1].folded_s == pytest.approx(2 * PAUSE_S, abs=0.06)


@pytest.mark.parametrize("begun_s", [(1000.25, 8200.5), (None, None)])
@pytest.mark.parametrize("rates", [(400, 400), (1600, 1000)])
def test_file_gives_back_the_same_record(tmp_path, begun_s, rates):
    a, b = record(rates[0], 0.01, working=True), record(rates[1], 0.004, working=True, name="b", seed=2)
    a, b = (replace(each, angle_rad=1 + 0.1 * each.time_s, pulse_rate_hz=40.0) for each in (a, b))
    joined = join([a, b], begun_s)
    again = through_file(joined, tmp_path)
    assert same(joined, again, but=("source",))
    assert again.source.parts == joined.source.parts
    assert again.source.recording_id == joined.source.recording_id
    assert again.source.name == "joined.csv" and len(again.source.sha256) == 64
    assert np.array_equal(again.part, joined.part)


def test_gap_in_a_part_and_a_pulse_rate_of_its_own_come_through_a_file(tmp_path):
    def at_30(name: str, seed: int) -> Record:
        whole = record(400, name=name, seed=seed)
        keep = (whole.time_s < 2) | (whole.time_s > 2.7)
        names = np.array(whole.segment_names)[whole.segment][keep]
        columns = [column[keep] for column in (whole.time_s, whole.pulse_width_us, whole.torque_nm)]
        return Record.from_arrays(*columns, names, pulse_rate_hz=30.0, source=whole.source)

    joined = join([at_30("a", 1), at_30("b", 2)], [0.0, 9.0])
    again = through_file(joined, tmp_path)
    assert again.pulse_rate_hz == 30.0
    assert same(joined, again, but=("source",))


def test_joined_record_is_joined_again_with_its_parts(tmp_path):
    a, b, c = (record(400, 0.01, name=name, seed=seed) for seed, name in enumerate("abc"))
    at_once = join([a, b, c], [0.0, 100.0, 20.0])
    in_steps = join([through_file(join([a, b], [0.0, 100.0]), tmp_path), c], [None, 20.0])
    assert [source.recording_id[-1] for source in in_steps.source.parts] == ["a", "c", "b"]
    assert in_steps.source == at_once.source
    assert in_steps.segment_names == at_once.segment_names
    assert np.allclose(in_steps.time_s, at_once.time_s, atol=1e-9, rtol=0)
    assert np.array_equal(in_steps.torque_nm, at_once.torque_nm)
    for one, other in zip(in_steps.parts, at_once.parts, strict=True):
        assert (one.first, one.begun_s, one.pause_s, one.folded_s) == (
            other.first, other.begun_s, other.pause_s, other.folded_s,
        )  # fmt: skip


def test_plain_record_is_one_part():
    plain = record(400)
    assert plain.parts == (Part(),)
    assert not plain.part.any() and plain.part.shape == plain.time_s.shape
    assert not make_grid(plain).part.any()
    alone = join([plain], [7.0])
    assert same(alone, plain, but=("parts",))
    assert alone.parts == (Part(begun_s=7.0),)


def test_column_part_of_somebody_else_is_passed_over(tmp_path):
    rows = [f"{i / 40:.4f},{100 * (i % 3)},{0.1 * i:.3f},prbs,left" for i in range(20)]
    path = tmp_path / "x.csv"
    path.write_text("time_s,pulse_width_us,torque_nm,segment,part\n" + "\n".join(rows) + "\n")
    assert identify.read(path).parts == (Part(),)


@pytest.mark.parametrize(
    ("column", "value", "says"),
    [
        ("part", "2", "part 1 begins"),
        ("pause_s", "", "'' is not 0 to 86400"),
        ("pause_s", "nan", "is not 0 to 86400"),
        ("folded_s", "4000", "is not 0 to"),
        ("folded_s", "29", "longer than the jump"),
        ("begun_s", "yesterday", "is not 0 to"),
        ("pulse_rate_hz", "30", "different pulse rates"),
        ("recording_id", "x" * 400, "cannot be"),
        ("time_s", "0", "time runs backwards"),
    ],
)
def test_file_with_wrong_parts_is_refused(tmp_path, column, value, says):
    a, b = record(400), record(400, name="b", seed=2)
    path = tmp_path / "joined.csv"
    write_joined(join([a, b], [0.0, 16.0] if column == "folded_s" else [0.0, 100.0]), path)
    lines = path.read_text().splitlines()
    place = lines[0].split(",").index(column)
    for number in range(a.time_s.size + 1, len(lines)) if column == "part" else [a.time_s.size + 1]:
        cells = lines[number].split(",")
        cells[place] = value
        if column == "folded_s":
            cells[lines[0].split(",").index("pause_s")] = "30"
        lines[number] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(identify.BadRecord, match=says):
        identify.read(path)


def test_what_cannot_be_joined_is_refused():
    a = record(400)
    with pytest.raises(identify.BadRecord, match="30 pulses/s, the first has 40"):
        join([a, replace(a, pulse_rate_hz=30.0)], [None, None])
    with pytest.raises(identify.BadRecord, match="sampled at 50 and 400 Hz"):
        join([a, record(50)], [None, None])
    with pytest.raises(identify.BadRecord, match="0 records"):
        join([], [])
    with pytest.raises(identify.BadRecord, match="begins"):
        join([a], [])


@pytest.mark.parametrize("apart_nm", [10.0, 1000.0])
def test_the_zeros_of_parts_may_be_far_apart(apart_nm: float) -> None:
    """A weak muscle beside the weight of an arm that was held otherwise in the second recording."""
    records = [make_record(Patient(), np.random.default_rng(seed), rate_hz=40, noise_nm=0.02)[0] for seed in (1, 2)]
    other = records[1].with_torque(records[1].torque_nm + apart_nm)
    together, away = (join([records[0], second], begun_s=[0.0, 200.0]) for second in (records[1], other))
    fits = [fit_plain(prepare(record)[0], prepare(record)[0].fitted) for record in (together, away)]
    assert fits[1].log_evidence == pytest.approx(fits[0].log_evidence, abs=0.5)
    assert fits[1].problem.setup.scale_nm == pytest.approx(fits[0].problem.setup.scale_nm, rel=1e-3)


def test_a_part_that_is_held_out_as_a_whole_has_its_own_zero() -> None:
    fitted, unseen = (
        make_record(Patient(), np.random.default_rng(seed), rate_hz=40, noise_nm=0.02)[0] for seed in (1, 2)
    )
    all_held_out = Record.from_arrays(
        unseen.time_s, unseen.pulse_width_us, unseen.torque_nm + 5.0, np.full(unseen.time_s.size, "validate")
    )
    model = identify.fit(join([fitted, all_held_out], begun_s=[0.0, 200.0]))
    assert model.fit["held_out_rms_nm"] < 0.05

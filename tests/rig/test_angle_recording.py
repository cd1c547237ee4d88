"""Times in a recording: torque and angles aligned on synthetic clocks, velocities, and what damage leaves of them."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.rig import align_angle, archive, assembly, journal
from stimrig.rig.adapters.files import Files
from stimrig.rig.align import align, cell_time
from stimrig.rig.align_angle import Reference
from stimrig.rig.errors import RecordingError
from stimrig.rig.journal import Kind
from stimrig.rig.signals import ANGLE_SAMPLE, SAMPLE
from tests.rig.fakes import VirtualRig
from tests.rig.test_angle_run import swinging
from tests.rig.test_damaged import blocks_of

pytestmark = pytest.mark.slow

CELL_HZ, SENSOR_HZ = 1600.0, 200.0
PPM = 150.0
"""By which the sensor's clock is fast."""


def on_one_bus(
    duration_s: float, rng: np.random.Generator, stamps: str = "", delay_ms: float = 2.0
) -> tuple[np.ndarray, Reference, np.ndarray]:
    """Angle samples, torque samples and when the angles were taken; both are read late, in batches, in their order.

    Without `stamps` there are none; of the "bus" one clock stamps both, of the "sensor" each stamps itself.
    """
    torque, angle = np.zeros(int(duration_s * CELL_HZ), SAMPLE), np.zeros(int(duration_s * SENSOR_HZ), ANGLE_SAMPLE)
    cell_s = np.arange(len(torque)) / CELL_HZ
    taken_s = 0.0021 + np.arange(len(angle)) / SENSOR_HZ / (1 + PPM * 1e-6)
    both_s = np.concatenate([cell_s, taken_s])
    order = np.argsort(both_s, kind="stable")
    batch_s = np.ceil(both_s[order] / 0.004) * 0.004 + 1e-3 * rng.exponential(delay_ms, len(order))
    read_s = np.empty(len(order))
    read_s[order] = np.maximum.accumulate(batch_s) + 1e-6 * np.arange(len(order))
    for samples, part, own_s in (
        (torque, slice(None, len(torque)), cell_s),
        (angle, slice(len(torque), None), taken_s),
    ):
        samples["host_time_s"] = 500.0 + read_s[part]
        samples["counter"] = 1000 + np.arange(len(samples))
        fast = 1 + (PPM * 1e-6 if samples is angle and stamps == "sensor" else 0.0)
        samples["stamp_s"] = 1.7e9 + (own_s + 60.0) * fast if stamps else np.nan
    return angle, Reference(torque, cell_s, 500.0, 0.2), taken_s


@pytest.mark.parametrize(
    ("stamps", "method", "within_ms"), [("bus", "stamps", 0.01), ("sensor", "order", 0.1), ("", "order", 0.1)]
)
def test_angles_on_the_cells_bus_are_aligned_with_the_torque(stamps: str, method: str, within_ms: float):
    for seed in range(3):
        angle, torque, taken_s = on_one_bus(20.0, np.random.default_rng(seed), stamps)
        time_s, told = align_angle.align_angle(angle, SENSOR_HZ, torque, of_the_cell=False, one_bus=True)
        assert told.method == method
        assert np.max(np.abs(time_s - taken_s)) * 1e3 < within_ms
        assert told.rate_ppm == pytest.approx(-PPM, abs=10.0)
        assert told.error_ms < 1.0


def test_a_standstill_of_the_host_shifts_no_angle():
    angle, torque, taken_s = on_one_bus(20.0, np.random.default_rng(0))
    for samples in (angle, torque.samples):
        late = (samples["host_time_s"] > 508.0) & (samples["host_time_s"] < 508.4)
        samples["host_time_s"][late] = 508.4 + 1e-3 * (samples["host_time_s"][late] - 508.0)
    time_s, told = align_angle.align_angle(angle, SENSOR_HZ, torque, of_the_cell=False, one_bus=True)
    assert told.method == "order"
    assert np.max(np.abs(time_s - taken_s)) < 2e-4


def test_a_sensor_in_step_with_the_cell_is_off_by_less_than_half_a_sample():
    angle, torque, _ = on_one_bus(20.0, np.random.default_rng(0))
    taken_s = 10 / CELL_HZ + np.arange(len(angle)) / SENSOR_HZ  # every eighth torque, to the microsecond
    at = np.searchsorted(torque.time_s, taken_s - 1e-9)
    angle["host_time_s"] = torque.samples["host_time_s"][np.minimum(at, len(torque.samples) - 1)] + 1e-7
    time_s, told = align_angle.align_angle(angle[:3900], SENSOR_HZ, torque, of_the_cell=False, one_bus=True)
    error_ms = np.abs(time_s - taken_s[:3900]) * 1e3
    assert np.max(error_ms) <= 0.5e3 / CELL_HZ + 0.01 and told.error_ms >= 1e3 / CELL_HZ / math.sqrt(12)


@pytest.mark.parametrize("per_frame", [1, 3])
def test_an_angle_in_the_cells_frame_has_exactly_its_time(per_frame: int):
    _, torque, _ = on_one_bus(5.0, np.random.default_rng(0))
    frames = len(torque.samples) // per_frame
    torque.samples["host_time_s"] = torque.samples["host_time_s"][
        np.arange(len(torque.samples)) // per_frame * per_frame
    ]
    angle = np.zeros(frames, ANGLE_SAMPLE)
    angle["host_time_s"] = torque.samples["host_time_s"][::per_frame][:frames]
    angle["counter"] = 70 + np.arange(frames)
    lost = Reference(np.delete(torque.samples, np.s_[600:660]), np.delete(torque.time_s, np.s_[600:660]), 500.0, 0.2)
    for reference in (torque, lost):
        time_s, told = align_angle.align_angle(angle, CELL_HZ / per_frame, reference, of_the_cell=True, one_bus=True)
        assert told.method == "cell"
        assert np.allclose(time_s, torque.time_s[per_frame - 1 :: per_frame][:frames], atol=1e-9)


def test_velocities_of_a_swing():
    time_s = np.arange(800) / SENSOR_HZ
    angle_rad = np.array([swinging(t) for t in time_s])
    true_rad_s = math.radians(30) * math.pi / 2 * np.cos(math.pi / 2 * time_s)
    noisy = angle_rad + math.radians(0.02) * np.random.default_rng(0).standard_normal(800)
    found = align_angle.centred(noisy, np.arange(800), SENSOR_HZ)
    assert np.max(np.abs(found - true_rad_s)[6:-6]) < 0.03
    assert np.max(np.abs(align_angle.centred(angle_rad, np.arange(800), SENSOR_HZ) - true_rad_s)) < 1e-3
    live = align_angle.LiveSlope(SENSOR_HZ)
    numbers = np.arange(800)
    late = np.concatenate([live.add(numbers[i : i + 7], angle_rad[i : i + 7]) for i in range(0, 800, 7)])
    before_s = time_s - align_angle.LIVE_WINDOW_S / 2
    assert np.max(np.abs(late - math.radians(30) * math.pi / 2 * np.cos(math.pi / 2 * before_s))[20:]) < 1e-3
    assert np.isnan(late[:2]).all()


def test_a_long_gap_breaks_the_velocity_and_a_short_one_does_not():
    number = np.delete(np.arange(400), [*range(100, 106), *range(200, 220)])
    angle_rad = np.where(number < 210, 0.01 * number, 5.0 - 0.01 * number)  # 2 rad/s, after the long gap -2 rad/s
    found = align_angle.centred(angle_rad, number, SENSOR_HZ)
    assert np.allclose(found, np.where(number < 210, 2.0, -2.0))
    assert np.isfinite(align_angle.centred(np.array([1.0]), np.array([5]), SENSOR_HZ)).all()


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> VirtualRig:
    """One that has played while the joint swung."""
    made = VirtualRig(tmp_path_factory.mktemp("swung"), has_sensor=True)
    made.sensor.angle_rad = swinging
    assert made.execute().outcome == "completed"
    return made


@pytest.fixture(scope="module")
def sealed(rig: VirtualRig) -> archive.Sealed:
    return rig.seal()


def test_the_sealed_file_holds_the_angle(rig: VirtualRig, sealed: archive.Sealed):
    with h5py.File(sealed.path) as file:
        group = file["angle"]
        assert {f"angle/{name}" for name in group} == {path for path, _, _ in archive.ANGLE_COLUMNS}
        assert all(group[name].attrs["unit"] and group[name].attrs["description"] for name in group)
        time_s = group["time_s"][:]
        assert 0 <= time_s[0] < 0.01 and np.diff(time_s) == pytest.approx(1 / 200)
        true_rad = np.array([swinging(t + rig.run.t0_s) for t in time_s])
        assert np.max(np.abs(group["angle_rad"][:] - true_rad)) < math.radians(0.1) + 0.001 * math.radians(48)
        assert np.allclose(group["raw"][:], 30.0 - np.degrees(group["angle_rad"][:]))
        assert group.attrs["method"] == "regression" and group.attrs["velocity_delay_s"] == 0.0
        assert group.attrs["velocity_method"] == "local quadratic over 60 ms, centred"
        assert group.attrs["velocity_window_s"] == 0.06 and "nurse" in group.attrs["calibration"]
        assert group.attrs["sample_rate_measured_hz"] == pytest.approx(200.0, rel=1e-3)
    assert archive.verify(sealed.path) == sealed.content_sha256


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = VirtualRig(tmp_path_factory.mktemp("plain"))
    rig.execute()
    return rig.seal().path


@pytest.mark.parametrize("change", ["value", "left out", "added"])
def test_a_changed_angle_is_found(tmp_path: Path, plain: Path, sealed: archive.Sealed, change: str):
    copy = Path(shutil.copy(plain if change == "added" else sealed.path, tmp_path))
    with h5py.File(copy, "a") as file:
        if change == "value":
            file["angle/angle_rad"][5] += 1e-6
        elif change == "left out":
            del file["angle"]
        else:
            for path, _, _ in archive.ANGLE_COLUMNS:
                file[path] = np.zeros(3)
    with pytest.raises(RecordingError, match="does not match"):
        archive.verify(copy)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("far too long", r"more than 1e\+09 bytes"),
        ("text", "not a readable recording.*holds no numbers"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, plain: Path, change: str, words: str):
    path = shutil.copy(plain, tmp_path)
    with h5py.File(path, "a") as file:
        del file["torque/torque_nm"]
        if change == "far too long":  # chunks that were never written take no room in the file
            file.create_dataset("torque/torque_nm", shape=(10**12,), dtype="f8", chunks=(1000,))
        else:
            file["torque/torque_nm"] = "none"
    with pytest.raises(RecordingError, match=words) as told:
        archive.verify(Path(path))
    assert "\n" not in str(told.value)


def damaged(rig: VirtualRig, folder: Path, blocks: list[int]) -> journal.JournalContents:
    """A copy of its journal with these blocks' payloads overwritten."""
    path, data = folder / "t.journal", bytearray(rig.path.read_bytes())
    for at in blocks:
        data[at + 20 : at + 24] = b"\xff" * 4
    path.write_bytes(bytes(data))
    return journal.read(path)


def test_angles_are_saved_where_both_headers_are_lost(tmp_path: Path, rig: VirtualRig):
    whole = rig.recording()
    found = assembly.assemble(damaged(rig, tmp_path, blocks_of(rig.path.read_bytes(), Kind.HEADER, Kind.PLAN)))
    assert "header are lost" in found.attributes["journal_note"]
    off_s = found.columns["angle/time_s"][0] - whole.columns["angle/time_s"][0]
    assert abs(off_s) < 0.02  # by times of arrival alone: the header said that both are on one bus
    n = min(len(found.columns["angle/angle_rad"]), len(whole.columns["angle/angle_rad"])) - 5
    assert n > 500 and np.array_equal(found.columns["angle/raw"][:n], whole.columns["angle/raw"][:n])
    assert found.angle["sample_rate_hz"] == pytest.approx(200.0, rel=0.02)


def test_lost_blocks_of_angles_are_gaps(tmp_path: Path, rig: VirtualRig):
    found = assembly.assemble(damaged(rig, tmp_path, blocks_of(rig.path.read_bytes(), Kind.ANGLE)[100:110]))
    gaps = found.columns["angle/gaps"]
    assert gaps.shape == (1, 2) and gaps[0, 1] == 20
    first = gaps[0, 0]
    assert np.diff(found.columns["angle/time_s"])[first - 1] == pytest.approx(21 / 200)
    assert archive.verify(archive.seal(found, tmp_path, Files()).path)


@pytest.mark.parametrize("back", [100, 20])
def test_angles_that_overlap_are_taken_once(tmp_path: Path, rig: VirtualRig, back: int):
    contents = journal.read(rig.path)
    angles = [np.frombuffer(payload, ANGLE_SAMPLE) for kind, payload in contents.blocks if kind == Kind.ANGLE]
    whole = np.concatenate(angles)
    again = np.concatenate([whole[:300], whole[300 - back :]])
    others = [block for block in contents.blocks if block[0] != Kind.ANGLE]
    doubled = replace(contents, blocks=[*others[:-1], (Kind.ANGLE, again.tobytes()), others[-1]])
    sealed = archive.seal(assembly.assemble(doubled), tmp_path, Files())
    columns = sealed.recording.columns
    assert np.all(np.diff(columns["angle/time_s"]) > 0) and np.all(np.diff(columns["angle/counter"]) > 0)
    assert identify.read(sealed.path).angle_rad is not None


RATE_HZ = 1600.0


def made(seed: int, ppm: float, jitter_ms: float, duration_s: float = 38.7, sync: bool = True):
    """A cell whose clock is off by `ppm`, samples that arrive late in batches, pulses that the cell sees."""
    rng = np.random.default_rng(seed)
    n = int(duration_s * RATE_HZ)
    counter = np.arange(n) + 12345
    true_s = 0.317 + np.arange(n) / RATE_HZ * (1 + ppm * 1e-6)
    late_s = rng.exponential(jitter_ms * 1e-3, n)
    late_s += (rng.random(n) < 2e-4) * rng.uniform(0, 0.05, n)  # the process was not scheduled
    arrived_s = true_s + 1e-4 + late_s
    host_s = np.maximum.accumulate(arrived_s)
    host_s = np.repeat(host_s[7::8], 8)[:n]
    host_s = np.concatenate([host_s, np.full(n - len(host_s), host_s[-1])])
    written_s = np.arange(0.5, duration_s, 0.025) + rng.exponential(1e-4, len(np.arange(0.5, duration_s, 0.025)))
    felt_s = written_s + 5e-5
    flag = np.zeros(n, np.uint8)
    seen = np.searchsorted(true_s, felt_s)
    flag[seen[seen < n]] = 1
    return counter, host_s, flag if sync else np.full(n, 255, np.uint8), written_s, true_s


@pytest.mark.parametrize("ppm", [-200.0, -3.0, 0.0, 200.0])
@pytest.mark.parametrize("jitter_ms", [0.2, 2.0])
@pytest.mark.parametrize("sync", [True, False])
def test_error_is_below_a_millisecond(ppm: float, jitter_ms: float, sync: bool):
    for seed in range(2):
        counter, host_s, flag, written_s, true_s = made(seed, ppm, jitter_ms, sync=sync)
        cell_s = cell_time(counter, np.full(len(counter), np.nan), RATE_HZ)
        time_s, found = align(cell_s, host_s, flag, written_s, RATE_HZ)
        assert found.method == ("sync" if sync else "regression")
        # without sync, nobody can see the transport's shortest delay (here 0.1 ms) and the batch's length
        known_s = 0.0 if sync else 1e-4
        error_s = time_s - true_s - known_s
        assert np.max(np.abs(error_s)) < 1e-3
        assert found.error_ms < 1.0
        assert found.rate_ppm == pytest.approx(ppm, abs=15)


@pytest.mark.parametrize("sync", [True, False])
def test_lost_samples_do_not_shift_the_rest(sync: bool):
    counter, host_s, flag, written_s, true_s = made(9, 50.0, 0.5, sync=sync)
    keep = np.ones(len(counter), bool)
    keep[20000:20800] = False
    keep[np.random.default_rng(1).random(len(keep)) < 0.02] = False
    cell_s = cell_time(counter[keep], np.full(keep.sum(), np.nan), RATE_HZ)
    time_s, _ = align(cell_s, host_s[keep], flag[keep], written_s, RATE_HZ)
    assert np.max(np.abs(time_s - true_s[keep])) < 1.2e-3


def test_the_stated_error_covers_the_true_one():
    """Over many clocks, the stated standard error is not smaller than what was really wrong."""
    wrong, stated = [], []
    for seed in range(20):
        counter, host_s, flag, written_s, true_s = made(100 + seed, 20.0, 0.5, duration_s=12.0)
        cell_s = cell_time(counter, np.full(len(counter), np.nan), RATE_HZ)
        time_s, found = align(cell_s, host_s, flag, written_s, RATE_HZ)
        wrong.append(float(np.mean(time_s - true_s)) * 1e3)
        stated.append(found.error_ms)
    assert np.sqrt(np.mean(np.square(wrong))) < 2 * np.mean(stated)


def test_too_little_to_align():
    time_s, found = align(np.array([0.0]), np.array([5.0]), np.array([0], np.uint8), np.empty(0), RATE_HZ)
    assert list(time_s) == [5.0]
    assert np.isnan(found.error_ms)


def test_a_cell_without_counter_is_counted_or_stamped():
    none = np.full(4, -1, np.int64)
    assert list(cell_time(none, np.full(4, np.nan), 1000.0)) == [0.0, 0.001, 0.002, 0.003]
    assert list(cell_time(none, np.array([7.0, 7.5, 8.0, 9.0]), 1000.0)) == [0.0, 0.5, 1.0, 2.0]


def test_a_clock_that_is_no_line_is_not_called_exact():
    """The cell samples 5 % faster from half-way on: a line misses by far more than its standard error."""
    rate, n = 1600.0, 20 * 1600
    period_s = np.where(np.arange(n) < n // 2, 1, 1 / 1.05) / rate
    true_s = np.cumsum(period_s)
    for wired in (True, False):
        pulses_s = 0.5 + np.arange(600) * 0.025
        sync = np.zeros(n, np.uint8) if wired else np.full(n, 255, np.uint8)
        if wired:
            sync[np.searchsorted(true_s, pulses_s)] = 1
        _, found = align(np.arange(n) / rate, true_s + 0.001, sync, pulses_s, rate)
        assert found.error_ms > 1.0


def test_a_host_that_falls_behind_does_not_mismatch_edges():
    """Samples come ever later (60 ms over 4 s, then all at once): the envelope bends, every pulse was still seen."""
    for seed in range(5):
        counter, host_s, flag, written_s, true_s = made(seed, 20.0, 0.2, duration_s=4.0)
        host_s = host_s + 0.06 * np.clip(true_s, 0, 3) / 3
        cell_s = cell_time(counter, np.full(len(counter), np.nan), RATE_HZ)
        time_s, found = align(cell_s, host_s, flag, written_s, RATE_HZ)
        assert np.max(np.abs(time_s - true_s)) < 1e-3
        assert found.error_ms < 1.0


@pytest.mark.parametrize("duration_s", [2.1, 3.0, 4.5])
@pytest.mark.parametrize("begins_s", [0.0, 0.4, 0.6])
def test_a_host_that_stands_still_for_most_of_a_short_test_does_not_bend_the_times(duration_s: float, begins_s: float):
    """Found by the simulator (seed 970498): 1.4 s came in one read, and the rate was taken for half of what it is."""
    true_s = np.arange(int(duration_s * 200)) / 200
    host_s = np.ceil(true_s / 0.03) * 0.03 + 0.002
    host_s[(host_s > begins_s) & (host_s < begins_s + 1.42)] = begins_s + 1.42
    time_s, alignment = align(true_s + 3.0, host_s, np.full(len(true_s), 255, np.uint8), np.zeros(0), 200.0)
    assert np.max(np.abs(time_s - true_s)) < 0.01
    assert not alignment.error_ms > 10  # where it is unknown, that is said


@pytest.mark.parametrize(("count", "apart_s"), [(3200, 0.0), (3200, 1e-4), (800, 0.0)])
def test_samples_that_all_came_in_a_moment_say_nothing_of_the_rate(count: int, apart_s: float):
    cell_s = np.arange(count) / 1600.0
    host_s = 2.0 + apart_s * (np.arange(count) // 800)
    time_s, alignment = align(cell_s, host_s, np.full(count, 255, np.uint8), np.zeros(0), 1600.0)
    assert np.isnan(alignment.error_ms)
    assert alignment.rate_ppm == 0.0
    assert np.diff(time_s) == pytest.approx(1 / 1600.0)
    assert time_s[-1] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("place", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("duration_s", [12, 16])
def test_lost_samples_of_a_cell_without_a_counter_are_not_called_exact(duration_s: int, place: float):
    true_s = np.arange(duration_s * 1600) / 1600.0
    came = np.abs(true_s - duration_s * place) > 0.05  # a tenth of a second is lost
    cell_s = np.arange(came.sum()) / 1600.0
    host_s = np.ceil(true_s[came] / 0.005) * 0.005 + 0.001
    time_s, alignment = align(cell_s, host_s, np.full(cell_s.size, 255, np.uint8), np.zeros(0), 1600.0)
    assert np.max(np.abs(time_s - true_s[came])) > 0.01
    assert alignment.error_ms > 5.0

"""The rest between tests outlives the process, and no wall clock shortens it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rig.clock import VirtualClock
from rig.control import rest
from rig.control.rest import Rest
from rig.errors import RecordingError

PULSE_S = 900.0


def left_behind(folder: Path, unix_start_s: float = 1_700_000_000.0) -> None:
    Rest(folder, VirtualClock(PULSE_S, unix_start_s)).pulse_at(PULSE_S)


@pytest.fixture(autouse=True)
def _boot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rest, "BOOT_ID", tmp_path / "boot_id")
    (tmp_path / "boot_id").write_text("this-boot\n")


def recalled(folder: Path, in_doubt: bool = False, now_s: float = 1000.0, unix_s: float = 1_700_000_100.0) -> float:
    found = Rest(folder, VirtualClock(now_s, unix_s))
    found.recall(in_doubt)
    assert found.last_pulse_s is not None
    return found.last_pulse_s


@pytest.mark.parametrize("hours", [-10_000, -24, 0, 24, 10_000])
def test_a_clean_restart_remembers_whatever_the_wall_clock_says(tmp_path: Path, hours: float):
    left_behind(tmp_path)
    assert recalled(tmp_path, unix_s=1_700_000_100.0 + 3600 * hours) == PULSE_S


def test_a_death_counts_from_now_and_anew_until_the_device_has_answered(tmp_path: Path):
    left_behind(tmp_path)
    assert recalled(tmp_path, in_doubt=True) == 1000.0
    assert recalled(tmp_path, now_s=1010.0) == 1010.0


@pytest.mark.parametrize(
    "content",
    [
        "", "[]", "{", "null", '{"boot_id": "this-boot"}', '{"boot_id": "another", "monotonic_s": 5}',
        '{"boot_id": "", "monotonic_s": 5}', '{"boot_id": "this-boot", "monotonic_s": NaN}',
        '{"boot_id": "this-boot", "monotonic_s": 1e9}', '{"boot_id": "this-boot", "monotonic_s": -5}',
    ],
)  # fmt: skip
def test_what_is_in_doubt_counts_from_now(tmp_path: Path, content: str):
    (tmp_path / "last-pulse.json").write_text(content)
    assert recalled(tmp_path) == 1000.0
    assert json.loads((tmp_path / "last-pulse.json").read_text())["monotonic_s"] == 1000.0


def test_a_machine_that_does_not_tell_its_boot_is_in_doubt(tmp_path: Path):
    left_behind(tmp_path)
    (tmp_path / "boot_id").unlink()
    assert recalled(tmp_path) == 1000.0


def test_a_folder_of_an_older_version_is_in_doubt_and_a_fresh_one_is_not(tmp_path: Path):
    fresh = Rest(tmp_path, VirtualClock())
    fresh.recall(in_doubt=False)
    assert fresh.last_pulse_s is None
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "20260101T000000Z_old.h5").touch()
    assert recalled(tmp_path) == 1000.0


def test_a_disk_that_refuses_leaves_no_older_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    left_behind(tmp_path)
    kept = Rest(tmp_path, VirtualClock(1000.0))

    def full(path: Path, data: bytes) -> None:
        raise rest.RecordingError(f"{path}: No space left on device")

    monkeypatch.setattr(rest.archive, "write_atomically", full)
    kept.pulse_at(1000.0)
    assert kept.last_pulse_s == 1000.0
    assert not (tmp_path / "last-pulse.json").exists()


def test_an_end_that_was_not_confirmed_counts_from_when_the_device_answers(tmp_path: Path):
    """A line that stalls may hold a pulse for longer than the process lives."""
    clock = VirtualClock()
    rest = Rest(tmp_path, clock)
    rest.pulse_at(clock.now_s(), ended=False)
    clock.advance(5.0)
    later = Rest(tmp_path, clock)
    later.recall(in_doubt=False)
    assert later.last_pulse_s == clock.now_s()
    clock.advance(2.0)
    later.settle()
    assert later.last_pulse_s == clock.now_s()
    clock.advance(2.0)
    later.settle()  # known by now
    assert later.last_pulse_s == clock.now_s() - 2.0


def test_after_a_death_the_rest_counts_from_when_the_device_answers(tmp_path: Path):
    clock = VirtualClock()
    Rest(tmp_path, clock).pulse_at(clock.now_s())
    again = Rest(tmp_path, clock)
    again.recall(in_doubt=True)
    clock.advance(3.0)
    again.settle()
    assert again.last_pulse_s == clock.now_s()


def test_a_disk_that_takes_and_gives_nothing_raises_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    def refuse_recording(*_: object) -> None:
        raise RecordingError("read-only")

    kept = Rest(tmp_path, VirtualClock())
    kept.pulse_at(5.0)
    monkeypatch.setattr(rest.archive, "write_atomically", refuse_recording)
    monkeypatch.setattr(Path, "unlink", refuse)
    kept.pulse_at(7.0)
    assert kept.last_pulse_s == 7.0

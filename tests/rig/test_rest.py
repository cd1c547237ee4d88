"""The rest between tests outlives the process, and no wall clock shortens it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stimrig.rig.adapters.files import Files
from stimrig.rig.control.memory import Rest
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

PULSE_S = 900.0


class Kept:
    """The rest of one process on a folder."""

    def __init__(self, folder: Path, now_s: float = 1000.0, unix_s: float = 1_700_000_100.0, boot: str = "a") -> None:
        self.machine = VirtualMachine(VirtualClock(now_s, unix_s))
        self.machine.boot_id = boot
        self.rest = Rest(folder, self.machine)

    def pulse_at(self, time_s: float, ended: bool = True) -> None:
        self.machine.run(self.rest.pulse_at(time_s, ended))

    def recalled(self, in_doubt: bool = False) -> float | None:
        self.machine.run(self.rest.recall(in_doubt))
        return self.rest.last_pulse_s

    def settled(self, after_s: float) -> float | None:
        """How long ago the last pulse was, once the device answers."""
        self.machine.wait(after_s)
        self.machine.run(self.rest.settle())
        return self.machine.clock.now_s() - (self.rest.last_pulse_s or 0.0)


@pytest.fixture
def left(tmp_path: Path) -> Path:
    """A folder with which a pulse was sent."""
    Kept(tmp_path, PULSE_S).pulse_at(PULSE_S)
    return tmp_path


@pytest.mark.parametrize("hours", [-10_000, -24, 0, 24, 10_000])
def test_a_clean_restart_remembers_whatever_the_wall_clock_says(left: Path, hours: float):
    assert Kept(left, unix_s=1_700_000_100.0 + 3600 * hours).recalled() == PULSE_S


def test_a_death_counts_from_now_and_anew_until_the_device_has_answered(left: Path):
    assert Kept(left).recalled(in_doubt=True) == 1000.0
    again = Kept(left, now_s=1010.0)
    assert again.recalled() == 1010.0
    assert again.settled(after_s=3.0) == 0.0


@pytest.mark.parametrize(
    "content",
    [
        "", "[]", "{", "null", '{"boot_id": "a"}', '{"boot_id": "another", "monotonic_s": 5}',
        '{"boot_id": "", "monotonic_s": 5}', '{"boot_id": "a", "monotonic_s": NaN}',
        '{"boot_id": "a", "monotonic_s": 1e9}', '{"boot_id": "a", "monotonic_s": -5}',
        '{"boot_id": "a", "monotonic_s": 5, "ended": false}', '{"boot_id": "another", "monotonic_s": 5, "ended": true}',
        '{"boot_id": "a", "monotonic_s": 1e9, "ended": true}', '{"boot_id": "a", "monotonic_s": NaN, "ended": true}',
    ],
)  # fmt: skip
def test_what_is_in_doubt_counts_from_now(tmp_path: Path, content: str):
    (tmp_path / "last-pulse.json").write_text(content)
    assert Kept(tmp_path).recalled() == 1000.0
    assert json.loads((tmp_path / "last-pulse.json").read_text())["monotonic_s"] == 1000.0


@pytest.mark.parametrize("boot", ["", "b"])
def test_a_machine_of_another_boot_or_one_that_does_not_tell_it_is_in_doubt(left: Path, boot: str):
    assert Kept(left, boot=boot).recalled() == 1000.0


def test_a_folder_of_an_older_version_is_in_doubt_and_a_fresh_one_is_not(tmp_path: Path):
    assert Kept(tmp_path).recalled() is None
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "20260101T000000Z_old.h5").touch()
    assert Kept(tmp_path).recalled() == 1000.0


@pytest.mark.parametrize("refuses", ["replace", "remove"])
def test_a_disk_that_refuses_leaves_no_older_time_and_raises_nothing(
    left: Path, monkeypatch: pytest.MonkeyPatch, refuses: str
):
    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    kept = Kept(left)
    for name in {"replace", refuses}:
        monkeypatch.setattr(Files, name, refuse)
    kept.pulse_at(1000.0)
    assert kept.rest.last_pulse_s == 1000.0
    assert (left / "last-pulse.json").exists() is (refuses == "remove")


def test_an_end_that_was_not_confirmed_counts_from_when_the_device_answers(tmp_path: Path):
    """A line that stalls may hold a pulse for longer than the process lives."""
    Kept(tmp_path).pulse_at(1000.0, ended=False)
    later = Kept(tmp_path, now_s=1005.0)
    assert later.recalled() == 1005.0
    assert later.settled(after_s=2.0) == 0.0
    assert later.settled(after_s=2.0) == 2.0, "known by now"

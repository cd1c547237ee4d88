"""The journal: whatever is cut or damaged, everything else comes back."""

from __future__ import annotations

import fcntl
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stimrig.rig import journal
from stimrig.rig.control.sealing import RecordingStore
from stimrig.rig.errors import JournalError, RecordingError
from stimrig.rig.journal import Kind
from tests.rig.fakes import journal_at
from tests.rig.live import LiveRig
from tests.simulator.disk import SimulatedDisk
from tests.simulator.virtual_time import VirtualMachine
from tests.simulator.world import World

BLOCKS = [(Kind.HEADER, b'{"a": 1}'), (Kind.PLAN, b""), (Kind.TORQUE, bytes(range(200))), (Kind.END, b"{}")]


def written(path: Path) -> bytes:
    book = journal_at(path)
    for kind, payload in BLOCKS:
        book.append(kind, payload)
    book.close()
    return path.read_bytes()


def test_blocks_come_back(tmp_path: Path):
    written(tmp_path / "j")
    contents = journal.read(tmp_path / "j")
    assert contents.blocks == BLOCKS
    assert contents.ended
    assert (contents.damaged_bytes, contents.blocks_missing) == (0, 0)
    assert contents.first_json(Kind.HEADER) == {"a": 1}
    assert contents.first_json(Kind.START) is None


def test_after_an_error_of_the_disk_it_is_closed_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    book = journal_at(tmp_path / "j")
    with monkeypatch.context() as full:
        full.setattr(os, "write", lambda *_: 0)
        with pytest.raises(JournalError):
            book.append(Kind.PLAN, b"abc")
    book.close()
    with (tmp_path / "j").open() as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nobody holds it any more


def test_a_start_that_the_disk_refuses_leaves_no_journal(make: Callable[..., LiveRig], tmp_path: Path):
    live = make(disk=(disk := SimulatedDisk(World(0))))
    disk.access = lambda: setattr(disk, "free", 1000)
    with pytest.raises(JournalError):
        live.start(live.plan("refused"))
    assert not any(path.suffix == ".journal" for path in disk.files)


def test_cut_anywhere_only_the_tail_is_lost(tmp_path: Path):
    whole = written(tmp_path / "j")
    ends = [len(journal.MAGIC)]
    for _, payload in BLOCKS:
        ends.append(ends[-1] + 16 + len(payload))
    for length in range(len(journal.MAGIC), len(whole) + 1):
        cut = tmp_path / "cut"
        cut.write_bytes(whole[:length])
        assert journal.read(cut).blocks == BLOCKS[: sum(length >= end for end in ends[1:])]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_damage_costs_the_damaged_block_only(tmp_path: Path, data: st.DataObject):
    path = tmp_path / "j"
    path.unlink(missing_ok=True)
    whole = bytearray(written(path))
    at = data.draw(st.integers(len(journal.MAGIC), len(whole) - 1))
    whole[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(whole)
    contents = journal.read(path)
    assert contents.damaged_bytes > 0
    ends = itertools.accumulate((16 + len(payload) for _, payload in BLOCKS), initial=len(journal.MAGIC))
    hit = sum(at >= end for end in ends) - 1
    assert contents.blocks == BLOCKS[:hit] + BLOCKS[hit + 1 :]


def test_a_full_disk_is_told_and_nothing_follows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    book = journal_at(tmp_path / "j")
    book.append(Kind.EVENT, b"1")
    real = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: real(fd, data[: len(data) // 2]))
    with pytest.raises(JournalError, match="the test stops"):
        book.append(Kind.EVENT, b"2")
    monkeypatch.setattr(os, "write", real)
    with pytest.raises(JournalError):
        book.append(Kind.EVENT, b"3")
    book.close()
    contents = journal.read(tmp_path / "j")
    assert contents.blocks == [(Kind.EVENT, b"1")]


def test_mistakes_are_named(tmp_path: Path):
    with pytest.raises(RecordingError, match="No such file"):
        journal.read(tmp_path / "none")
    (tmp_path / "other").write_bytes(b"hello")
    with pytest.raises(RecordingError, match="is not a journal"):
        journal.read(tmp_path / "other")
    journal_at(tmp_path / "j").close()
    store = RecordingStore(SimpleNamespace(data_dir=tmp_path), VirtualMachine())  # pyright: ignore[reportArgumentType]
    with pytest.raises(JournalError, match="File exists"):
        store._create(tmp_path / "j")

"""What is dear is made once, however many processes ask for it at once, and never from what another run made."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest

from tests.harness import made_once


@made_once.made_once
def dear(path: str, number: int) -> list[int]:
    with Path(path).open("a") as file:
        file.write("made ")
    time.sleep(0.1)  # long enough for others to come meanwhile
    return [number]


def asks(folder: Path, path: str, number: int, told: multiprocessing.SimpleQueue[list[int]]) -> None:
    made_once.folder = folder
    told.put(dear(path, number))


def test_processes_that_ask_at_once_are_given_the_same(tmp_path: Path) -> None:
    fork = multiprocessing.get_context("fork")
    told, path = fork.SimpleQueue(), tmp_path / "calls"
    others = [fork.Process(target=asks, args=(tmp_path, str(path), number, told)) for number in (1, 1, 1, 2)]
    for other in others:
        other.start()
    assert sorted(told.get() for _ in others) == [[1], [1], [1], [2]]
    for other in others:
        other.join()
    assert path.read_text() == "made made "


def test_what_could_not_be_made_is_made_by_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(made_once, "folder", tmp_path)
    with pytest.raises(FileNotFoundError):
        dear(str(tmp_path / "later" / "calls"), 3)
    (tmp_path / "later").mkdir()
    assert dear(str(tmp_path / "later" / "calls"), 3) == [3]

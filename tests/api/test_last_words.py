"""What a process said last, as the launcher tells it: whatever its log is, nobody else ends because of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from api.cli.launcher import LAST_BYTES, Child


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (None, ""), ("", ""), ('{"message": "all went well"}\n', "all went well"),
        ("outbox: no room\n", "outbox: no room"),
        ('{"time": "2026-11-23T08:0', ""), ('{"level": "info"}\n', ""), ("{" * 100_000, ""),
        ("x" * 3 * LAST_BYTES + "\noutbox: gone\n", "outbox: gone"),
    ],
)  # fmt: skip
def test_whatever_its_log_is(tmp_path: Path, log: str | None, words: str) -> None:
    if log is not None:
        (tmp_path / "outbox.log").write_text(log)
    assert Child("outbox", [], tmp_path / "outbox.log").last_words() == words

"""Outputs of the verbs: which files are refused before anything is computed, and how they are written."""

from __future__ import annotations

import os
from pathlib import Path

from stimrig.api.cli.files import check_outputs, write


def test_devices_and_pipes_are_written_directly(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    pipe = tmp_path / "stdout"
    pipe.symlink_to(f"/dev/fd/{writer}")
    check_outputs([], Path("/dev/null"), Path("/dev/null"), pipe)
    write(pipe, "content")
    os.close(writer)
    assert os.read(reader, 100) == b"content" and pipe.is_symlink()
    os.close(reader)

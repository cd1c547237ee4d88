"""The experiment that decides, from recordings that are there: what is asked of the rig, and what both then say."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import load_record
from stimrig.api.progress_bar import progress_bar


def asked(data: Sequence[Path]) -> dict[str, Any]:
    """The next experiment of recordings as a test.

    Raises
    ------
    InputError
        Nothing is left to decide.
    """
    record = load_record(data)
    with progress_bar() as progress:
        experiment = identify.next_experiment(identify.diagnose(record, None, progress))
    if experiment is None:
        raise InputError(f"{data[0]}: no experiment is asked for: nothing is left to decide. Leave out --decide.")
    segments = [dict(segment) for segment in experiment.segments]
    return {"kind": "next-experiment", "segments": segments, "pulse_rate_hz": record.pulse_rate_hz}


def diagnosed(data: Sequence[Path], recording: bytes) -> dict[str, Any]:
    """What is missing by the recordings and a new one together."""
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        new = Path(folder) / "recording.h5"
        new.write_bytes(recording)
        found = identify.diagnose(load_record([*data, new]), None, progress).to_dict()
    return {"structure": [], **found}

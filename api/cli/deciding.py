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
from stimrig.identify.records.join import LEAST_SAMPLES, samples_between


def asked(data: Sequence[Path], participant: str | None) -> dict[str, Any]:
    """The next experiment of recordings as a test, with the participant whose recordings they are.

    Raises
    ------
    InputError
        Nothing is left to decide; it is not known whose they are, or they are another's; or no further recording could
        be joined to them. All of it is said before anything is played.
    """
    record = load_record(data)
    owner = _owner(record, data[0], participant)
    if samples_between(record.sample_rate_hz, record.pulse_rate_hz) < LEAST_SAMPLES:
        least = f"{LEAST_SAMPLES * record.pulse_rate_hz:g} Hz"
        raise InputError(
            f"{data[0]}: sampled at {record.sample_rate_hz:.4g} Hz; a further one is joined from {least} on."
        )
    with progress_bar() as progress:
        experiment = identify.next_experiment(identify.diagnose(record, None, progress))
    if experiment is None:
        raise InputError(f"{data[0]}: no experiment is asked for: nothing is left to decide. Leave out --decide.")
    segments = [dict(segment) for segment in experiment.segments]
    return {
        "participant": owner,
        "kind": "next-experiment",
        "segments": segments,
        "pulse_rate_hz": record.pulse_rate_hz,
    }


def _owner(record: identify.Record, file: Path, participant: str | None) -> str:
    """Who is stimulated: whose recordings these are."""
    sources = record.source.parts or (record.source,)
    owners = {source.participant for source in sources} - {""}
    if len(owners) > 1:
        raise InputError(f"these recordings are of several people: {', '.join(sorted(owners))}.")
    owner = next(iter(owners), participant)
    if owner is None:
        raise InputError(f"{file} does not say whose it is. Give --participant.")
    if participant not in (None, owner):
        raise InputError(f"{file} is a recording of {owner}; --participant is {participant}.")
    return owner


def diagnosed(data: Sequence[Path], recording: bytes) -> dict[str, Any]:
    """What is missing by the recordings and a new one together."""
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        new = Path(folder) / "recording.h5"
        new.write_bytes(recording)
        found = identify.diagnose(load_record([*data, new]), None, progress).to_dict()
    return {"structure": [], **found}

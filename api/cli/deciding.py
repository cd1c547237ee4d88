"""Plans the deciding experiment from existing recordings, and diagnoses them together with its recording."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import load_record
from stimrig.api.client.errors import NotFound
from stimrig.api.client.rest import Client
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import held_by
from stimrig.identify.records.join import LEAST_SAMPLES, samples_between
from stimrig.identify.records.record import Source


def plan_experiment(data: Sequence[Path], participant: str | None) -> dict[str, Any]:
    """Plan the next experiment of recordings as a test of the participant whose recordings they are.

    Beside it `recorded_ma`, with what current they were made, mA.

    Raises InputError: nothing is left to decide; it is not known whose they are, or they are another's; they were made
    with several currents, or do not say with which; or no further recording could be joined to them. All of it is said
    before anything is played.
    """
    record = load_record(data)
    sources = record.source.parts or (record.source,)
    owner = _owner(sources, data, participant)
    currents_ma = sorted({source.current_ma for source in sources if source.current_ma is not None})
    if len(currents_ma) > 1:
        made_with = " and ".join(f"{current:g} mA" for current in currents_ma)
        raise InputError(f"these recordings were made with {made_with}. Give those of one current.")
    if samples_between(record.sample_rate_hz, record.pulse_rate_hz) < LEAST_SAMPLES:
        lowest_rate = f"{LEAST_SAMPLES * record.pulse_rate_hz:g} Hz"
        raise InputError(
            f"{data[0]}: sampled at {record.sample_rate_hz:.4g} Hz; a further one is joined from {lowest_rate} on."
        )
    if any(source.current_ma is None for source in sources):  # a table that others wrote, or that was joined
        fix = "Give the rig's own recordings (HDF5), each by itself."
        raise InputError(f"{data[0]} does not say with what current it was made. {fix}")
    with progress_bar() as progress:
        explained = identify.explain(record, progress)
    experiment = identify.next_experiment(explained.diagnosis) or identify.next_experiment(explained.left)
    if experiment is None:
        raise InputError(f"{data[0]}: no experiment is asked for: nothing is left to decide. Leave out --decide.")
    return {
        "participant": owner,
        "kind": "next-experiment",
        "segments": [dict(segment) for segment in experiment.segments],
        "pulse_rate_hz": record.pulse_rate_hz,
        "recorded_ma": currents_ma[0],
    }


def _owner(sources: Sequence[Source], data: Sequence[Path], participant: str | None) -> str:
    owners = {source.participant for source in sources} - {""}
    if len(owners) > 1:
        raise InputError(f"these recordings are of several people: {', '.join(sorted(owners))}.")
    if participant is None and not all(source.participant for source in sources):
        silent = [file for file, source in zip(data, sources, strict=False) if not source.participant]
        which = silent[0] if len(sources) == len(data) else data[0]  # a joined file has several
        raise InputError(f"{which} does not say whose it is. Give --participant.")
    owner = next(iter(owners), participant)
    assert owner is not None
    if participant not in (None, owner):
        raise InputError(f"{data[0]} is a recording of {owner}; --participant is {participant}.")
    return owner


def check_participant(client: Client, code: str, recorded_ma: float | None) -> None:
    """Check, before anything is played, that the participant is known and has the recordings' current.

    Raises InputError: somebody who has recordings would be made anew, with default limits; or the current is another
    one.
    """
    try:
        now_ma = client.participant(code)["profile"]["current_ma"]
    except NotFound as error:
        fix = "their limits are not known here. Give the --data folder or --url of the recording, or set them first."
        raise InputError(f"there is no participant {code}: {fix}") from error
    if recorded_ma not in (None, now_ma):
        now = f"{code} is now stimulated with {now_ma:g} mA"
        raise InputError(f"the recording was made with {recorded_ma:g} mA, {now}: they cannot be joined.")


def diagnose_together(data: Sequence[Path], recording: bytes) -> dict[str, Any]:
    """Diagnose the recordings and a new one together; `remaining` is what is missing once that is added."""
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        new = Path(folder) / "recording.h5"
        new.write_bytes(recording)
        record = load_record([*data, new])
        explained = identify.explain(record, progress)
    structure = held_by(explained.improvement.models[-1], record)
    remaining = {"structure": structure, **explained.left.to_dict()}
    return {"structure": [], **explained.diagnosis.to_dict(), "left": remaining}

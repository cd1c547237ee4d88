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


def plan_experiment(data: Sequence[Path], participant: str | None) -> dict[str, Any]:
    """Plan the next experiment of recordings as a test of the participant whose recordings they are.

    Beside it `recorded_ma`, with what current they were made, mA.

    Raises InputError: nothing is left to decide; it is not known whose they are, or they are another's; they were made
    with several currents, or do not say with which; or no further recording could be joined to them. All of it is said
    before anything is played.
    """
    record = load_record(data)
    sources = record.source.parts or (record.source,)
    files = data if len(sources) == len(data) else [data[0]] * len(sources)  # a joined file has several sources
    for file, source in zip(files, sources, strict=True):
        if not (source.participant or participant):
            raise InputError(f"{file} does not say whose it is. Give --participant.")
        if source.current_ma is None:  # a table that others wrote, or that was joined
            fix = "Give the rig's own recordings (HDF5), each by itself."
            raise InputError(f"{file} does not say with what current it was made. {fix}")
    owners = sorted({source.participant for source in sources} - {""} | ({participant} if participant else set()))
    currents_ma = sorted({source.current_ma for source in sources})
    if len(owners) > 1:
        raise InputError(f"these recordings, or they and --participant, are of several people: {', '.join(owners)}.")
    if len(currents_ma) > 1:
        made_with = " and ".join(f"{current:g} mA" for current in currents_ma)
        raise InputError(f"these recordings were made with {made_with}. Give those of one current.")
    if samples_between(record.sample_rate_hz, record.pulse_rate_hz) < LEAST_SAMPLES:
        lowest_rate = f"{LEAST_SAMPLES * record.pulse_rate_hz:g} Hz"
        raise InputError(
            f"{data[0]}: sampled at {record.sample_rate_hz:.4g} Hz; a further one is joined from {lowest_rate} on."
        )
    with progress_bar() as progress:
        explained = identify.explain(record, progress)
    experiment = identify.next_experiment(explained.diagnosis) or identify.next_experiment(explained.left)
    if experiment is None:
        raise InputError(f"{data[0]}: no experiment is asked for: nothing is left to decide. Leave out --decide.")
    return {
        "participant": owners[0],
        "kind": "next-experiment",
        "segments": [dict(segment) for segment in experiment.segments],
        "pulse_rate_hz": record.pulse_rate_hz,
        "recorded_ma": currents_ma[0],
    }


def check_participant(client: Client, code: str, recorded_ma: float) -> None:
    """Check, before anything is played, that the participant is known and has the recordings' current.

    Raises InputError: somebody who has recordings would be made anew, with default limits; or the current is another
    one.
    """
    try:
        now_ma = client.participant(code)["profile"]["current_ma"]
    except NotFound as error:
        fix = "their limits are not known here. Give the --data folder or --url of the recording, or set them first."
        raise InputError(f"there is no participant {code}: {fix}") from error
    if recorded_ma != now_ma:
        now = f"{code} is now stimulated with {now_ma:g} mA"
        raise InputError(f"the recording was made with {recorded_ma:g} mA, {now}: they cannot be joined.")


def diagnose_together(data: Sequence[Path], recording: bytes) -> tuple[identify.Explanation, dict[str, Any]]:
    """Explain the recordings and a new one together; and return its keys of `--json`.

    `left` is what is missing once all that the diagnosis names is added.
    """
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        new = Path(folder) / "recording.h5"
        new.write_bytes(recording)
        record = load_record([*data, new])
        explained = identify.explain(record, progress)
    remaining = {"structure": held_by(explained.improvement.models[-1], record), **explained.left.to_dict()}
    return explained, {"structure": [], **explained.diagnosis.to_dict(), "left": remaining}

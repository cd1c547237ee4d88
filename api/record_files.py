"""Recordings as files: several read as one record, written as CSV, found again.

Imported by the worker and the command line only.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.whole_file import sha256_of
from stimrig.identify.records import HDF5_MAGIC
from stimrig.identify.records.join import join, write_joined

Progress = Callable[[float, str], None]
JOINT = ("angle_rad", "velocity_rad_s")


def read(
    paths: Sequence[Path],
    columns: Sequence[str] | None = None,
    needs: Sequence[str] = (),
    name: Callable[[int], str] | None = None,
    note: Callable[[str], None] | None = None,
) -> Any:
    """Read one file, or several joined to one record.

    `paths`: at least one; where all begins are known they are put in the order of time. `needs`: columns that each of
    them must have. `name`: how a file is called in an error, by its number from 0; else its path. `note`: gets what was
    assumed, a line each.

    Raises BadRecord: a file cannot be read or lacks a column, or they do not go together: names the file.
    """
    called = [name(number) if name else str(path) for number, path in enumerate(paths)]
    records = [identify.read(path, map=columns) for path in paths]
    report = note or (lambda _words: None)
    for record, place in zip(records, called, strict=True):
        for words in record.notes:
            report(f"{place}: {words}")
        if lacking := [column for column in needs if getattr(record, column) is None]:
            message = f"it has no {', '.join(lacking)}, which an effect of the model needs"
            fix = "Leave it out, or record it anew on a rig with an angle sensor."
            raise identify.BadRecord(message, place=place, fix=fix)
    if len(records) == 1:
        return records[0]
    for column in JOINT:
        lacking = [place for record, place in zip(records, called, strict=True) if getattr(record, column) is None]
        if 0 < len(lacking) < len(records):
            report(f"{', '.join(lacking)}: no {column}, so it is left out of the joined record")
    try:
        return join(records, [begun(path) for path in paths])
    except identify.BadRecord as error:
        numbers = {f"recording {number}": place for number, place in enumerate(called, start=1)}
        raise identify.BadRecord(error.message, place=numbers.get(error.place, error.place), fix=error.fix) from error


def begun(path: Path) -> float | None:
    """When a sealed recording's clock was 0, as Unix time; None for CSV: a joined one says it of its parts."""
    try:
        with path.open("rb") as file:
            if file.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
                return None
        from stimrig.identify.records.recording import attributes  # imported here: a table needs no h5py

        return datetime.fromisoformat(attributes(path, ["created_utc"])["created_utc"]).timestamp()
    except (identify.IdentifyError, OSError, ValueError, OverflowError):
        return None


def joined(parts: Sequence[str], out: str, progress: Progress, needs: Sequence[str] = ()) -> dict[str, Any]:
    """Recordings as the parts of one, written to `out` as CSV that `identify.read` reads; its SHA-256.

    `needs` are columns that each of them must have.
    """
    progress(0.1, "joining the recordings")
    whole = read([Path(part) for part in parts], needs=needs, name=lambda number: f"recording {number + 1}")
    write_joined(whole, Path(out))
    return {"file_sha256": sha256_of(Path(out))}


def plain_csv(data: str, progress: Progress, out: str, columns: Sequence[str] = ()) -> dict[str, Any]:
    """A recording, or a table of another tool by what `--map` says of its columns, as CSV in our own layout."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data), map=list(columns) or None)
    progress(0.7, "writing")
    write_joined(record, Path(out))
    return {"notes": list(record.notes), "of": record.source.participant}


def samples_sha256(record: Any) -> str:
    """Return a digest of the torque with eight digits: the same for each file of the same samples."""
    return hashlib.sha256("\n".join(f"{value:.8g}" for value in record.torque_nm.tolist()).encode()).hexdigest()


def samples(progress: Progress, paths: Sequence[str]) -> dict[str, Any]:
    """Return the digest of each recording's samples; empty where it cannot be read."""
    digests = []
    for number, path in enumerate(paths):
        progress(number / len(paths), "comparing with stored recordings")
        try:
            digests.append(samples_sha256(identify.read(Path(path))))
        except (identify.IdentifyError, OSError):
            digests.append("")
    return {"digests": digests}


def find_recording(progress: Progress, folder: str, test_id: str) -> dict[str, Any]:
    """Find the sealed recording of a test whose end the service missed."""
    from stimrig.api.store.uploads import PREFIX
    from stimrig.identify.records.recording import attributes

    progress(0.1, "looking through the recordings")
    for path in sorted(Path(folder).glob("**/*.h5")):
        if path.name.startswith(PREFIX):
            continue  # an upload is no recording of this rig, whatever test it names
        try:
            fields = attributes(path, ["test_id", "recording_id", "outcome", "reason"])
        except identify.IdentifyError:
            continue
        if fields.pop("test_id") == test_id:
            return {"found": {**fields, "recording_path": str(path), "file_sha256": sha256_of(path)}}
    return {"found": None}

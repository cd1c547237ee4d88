"""`python -m stimrig.rig.recover JOURNAL`: seal a journal by hand, whole, half-written or damaged.

The journal is only read and stays where it is. The output and the recording's attribute `journal_note` say what could
not be read and what had to be inferred. Exit 2: there is nothing to seal, or a running rig still writes the journal.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.rig import archive, assembly, journal
from stimrig.rig.adapters.files import Files
from stimrig.rig.errors import BusyError, RecordingError, RigError
from stimrig.rig.signals import MAY_BE_FELT, PulseStatus

UNKNOWN_END = "recovered by hand; the journal does not say how the test ended"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m stimrig.rig.recover", description="Seal a journal by hand.")
    parser.add_argument("journal", type=Path, metavar="JOURNAL")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: recordings/ of its data folder")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    options = parser.parse_args(arguments)
    try:
        with _nobody_writes(options.journal):
            result = recover(options.journal, options.output or _folder_of(options.journal))
    except RigError as error:
        print(f"recover: {error}", file=sys.stderr)
        return 2
    print(json.dumps(result, ensure_ascii=False) if options.json else _words(result))
    return 0


def recover(path: Path, folder: Path) -> dict[str, Any]:
    """Seal what the journal holds into the folder, and return a summary.

    Raises RecordingError: not a journal, nothing to seal, a disk error, or another recording of that name exists.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder; make it, or give another with -o")
    recording = assembly.assemble(journal.read(path), "fault", UNKNOWN_END)
    target = archive.place(recording, folder)
    known = target.exists() and archive.verify(target) == archive.content_sha256(recording.columns)
    if target.exists() and not known:
        raise RecordingError(f"{target}: another recording of this test exists; give another folder with -o")
    if not known:
        archive.seal(recording, folder, Files())
    status, attributes = recording.columns["pulses/status"], recording.attributes
    return {
        "recording": str(target),
        "was_there": known,
        **{name: attributes[name] for name in ("recording_id", "test_id", "participant", "outcome", "reason")},
        "pulses": int(np.sum(np.isin(status, MAY_BE_FELT))),
        "unacknowledged": int(np.sum(status == PulseStatus.UNACKNOWLEDGED)),
        "samples": len(recording.columns["torque/time_s"]),
        "damaged_bytes": attributes["journal_damaged_bytes"],
        "blocks_missing": attributes["journal_blocks_missing"],
        "note": attributes["journal_note"],
    }


@contextlib.contextmanager
def _nobody_writes(path: Path) -> Iterator[None]:
    """Lock the journal, and its data folder if it lies in one. Raises BusyError if a rig uses them."""
    locks = [path]
    if path.suffix == ".journal" and path.parent.name == "journals":
        locks.append(path.parent)
    with contextlib.ExitStack() as stack:
        for lock in filter(Path.exists, locks):
            try:
                fd = os.open(lock, os.O_RDONLY | os.O_CLOEXEC)
                stack.callback(os.close, fd)
                fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BusyError(
                    f"journal {path}: a running rig uses it and will seal it; stop that rig first"
                ) from None
            except OSError as error:
                raise RecordingError(f"{lock}: {error.strerror}") from None
        yield


def _folder_of(path: Path) -> Path:
    recordings = path.parent.parent / "recordings"
    return recordings if path.parent.name == "journals" and recordings.is_dir() else path.parent


def _words(result: dict[str, Any]) -> str:
    lines = [
        f"{'already sealed' if result['was_there'] else 'sealed'}: {result['recording']}",
        f"test {result['test_id']} of participant {result['participant']}, {result['outcome']}: "
        f"{result['reason'] or '-'}",
        f"{result['pulses']} pulses ({result['unacknowledged']} not acknowledged), {result['samples']} torque samples",
    ]
    return "\n".join([*lines, *([f"note: {result['note']}"] if result["note"] else [])])


if __name__ == "__main__":
    sys.exit(main())

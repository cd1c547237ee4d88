"""A BIDS-style folder: `sub-…/ses-…/beh/` with torque as physio, pulse widths as stim, pulses and segments as events.

BIDS 1.9: continuous recordings are gzipped tables without a header and with an even rate; their sidecar says columns,
units, rate and start. Labels are letters and digits.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any

import numpy as np

from stimrig.api.cohort.export import ERRORS, NoExport, Put, Who
from stimrig.api.cohort.export_state import FOLDER, State
from stimrig.api.cohort.select import LABELS
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.exchange.outward.parquet import COLUMNS, STATUS, Column, record_row, segment_at
from stimrig.api.version import software_version
from stimrig.identify.records.cells import cell_text

Words = dict[str, dict[str, Any]]


def _words(table: str, *names: str, **renamed: str) -> Words:
    """What the data dictionary says of columns, as BIDS writes it; `renamed`: by another name here."""
    said = {column.name: column for column in COLUMNS[table]}
    return {name: _word(said[column]) for name, column in {**dict(zip(names, names, strict=True)), **renamed}.items()}


def _word(column: Column) -> dict[str, Any]:
    among = "1: yes, 0: no" if column.type == "true or false" else column.range
    says = column.meaning.replace("null", "n/a") + (f" ({among})" if among not in column.meaning else "")
    unit = column.unit.replace("·", ".").replace("µ", "u")
    return {"Description": says, **({"Units": unit} if unit not in ("", "1") else {})}


PHYSIO = _words("samples", "time_s", "torque_nm", "angle_rad", "velocity_rad_s", "sync")
STIM = _words("samples", "pulse_width_us", "late_s", "doubted")
PULSE = {
    "pulse_width": "sent_pulse_width_us", "planned_pulse_width": "pulse_width_us", "current": "current_ma",
    "planned_onset": "planned_time_s", "acknowledged": "acknowledged_time_s",
}  # fmt: skip
"""Columns of a pulse's event, and those of the record's pulses that they are."""
EVENTS: Words = {
    "onset": {"Description": "begin of the segment; when the pulse's command had been written to the line (of one that "
              "was not sent: when it was due). Zero is the start of the first segment, as in the continuous recordings",
              "Units": "s"},
    "duration": {"Description": "of a segment; 0 for a pulse", "Units": "s"},
    "trial_type": {
        "Description": "what the row is",
        "Levels": {"segment": "a part of the test", "pulse": "a pulse that was sent",
                   "pulse_not_sent": "a planned pulse that was dropped or refused"},
    },
    "segment": {"Description": "name of the segment; rows of `validate` are held out from fits"},
    **_words("pulses", pulse_index="index", **PULSE, status="status"),
}  # fmt: skip
SCANS: Words = {
    "filename": {"Description": "the continuous recording of torque; its stim and events files are called alike"},
    **_words("records", acq_time="begun_utc"),
    **_words("records", *LABELS, "outcome", "duration_s", "sample_rate_hz", "record_id", "sha256"),
}
PARTICIPANTS: Words = {
    "participant_id": {"Description": "sub- and the label: the letters and digits of the code"},
    "code": {"Description": "the participant's code as it was given"},
    "sessions": {"Description": "number of sessions (days)"},
    "recordings": {"Description": "number of recordings"},
}
DESCRIPTION: dict[str, Any] = {
    "Name": "Electrically stimulated muscle: torque and pulses",
    "BIDSVersion": "1.9.0",
    "DatasetType": "raw",
}
README = """Torque at the elbow while a muscle is stimulated electrically, exported by stimrig.

Each recording is one test: `sub-<label>/ses-<day>/beh/sub-…_ses-…_task-<kind>_acq-<recording>_…`

- `…_physio.tsv.gz`: torque at the load cell's own rate (no header; columns, rate and start are in the JSON beside it);
- `…_stim.tsv.gz`: the pulse width in force at each of these samples;
- `…_events.tsv`: each pulse and each segment of the test;
- `…_scans.tsv` of a session: when each recording was made, and how it ended.

In a table `n/a` stands where nothing is known; in a continuous recording also where a sample was lost.

Row k of a continuous recording was measured at StartTime + k / SamplingFrequency, on the clock of the events. `acq-` is
the beginning of the SHA-256 of the exported file. A session is a day (UTC). `participants.tsv` says which code a label
stands for. What could not be exported is in `errors.csv`.
"""


NAME: str = "bids"
MOST_ROWS = 20_000_000
EVEN_S = 1e-6
"""Samples further from an even grid than this have a column of their own with their times."""


def write(record: WholeRecord, who: Who, put: Put) -> dict[str, Any]:
    """The record's files; its row of `scans.tsv`."""
    task = "".join(c for c in str(record.about.get("kind") or "") if c.isascii() and c.isalnum()) or "test"
    stem = f"sub-{who.label}_ses-{who.session}_task-{task}_acq-{who.key}"
    folder = f"sub-{who.label}/ses-{who.session}/beh"
    rate_hz, start_s, at, exact = grid(record)
    head = {
        "SamplingFrequency": rate_hz,
        "StartTime": start_s,
        "TaskName": record.about.get("kind") or "test",
        "RecordingID": who.record_id,
        "SHA256": record.sha256,
        "PulseRate": record.about.get("pulse_rate_hz"),
        **{f"Alignment_{key.removeprefix('alignment_')}": value for key, value in record.about.items()
           if key.startswith("alignment_")},
    }  # fmt: skip
    physio = [name for name in PHYSIO if name in record.samples and (name != "time_s" or not exact)]
    _continuous(put, f"{folder}/{stem}_physio", record, physio, at, {**head, **_described(PHYSIO, physio)})
    stim = [name for name in STIM if name in record.samples]
    _continuous(put, f"{folder}/{stem}_stim", record, stim, at, {**head, **_described(STIM, stim)})
    with put(f"{folder}/{stem}_events.tsv") as file:
        file.writelines(line.encode() for line in tsv(EVENTS, events(record)))
    _json(put, f"{folder}/{stem}_events.json", {**EVENTS, "TaskName": head["TaskName"]})
    return {**record_row(record, who), "label": who.label, "file": f"beh/{stem}_physio.tsv.gz"}


def _continuous(
    put: Put, place: str, record: WholeRecord, names: list[str], at: np.ndarray, head: dict[str, Any]
) -> None:
    columns = []
    for name in names:
        cells = np.full(int(at[-1]) + 1, "n/a", object)
        cells[at] = [cell(value) for value in record.samples[name].tolist()]
        columns.append(cells)
    with put(f"{place}.tsv.gz") as file, gzip.GzipFile("", "wb", 6, file, mtime=0) as packed:
        packed.write(("\n".join(map("\t".join, zip(*columns, strict=True))) + "\n").encode())
    _json(put, f"{place}.json", head)


def finish(state: State, put: Put) -> None:
    """What describes the whole, and the lists of participants and scans."""
    codes = {code: label for label, code in state.labels()}
    people: list[dict[str, Any]] = []
    for participant, sessions in groupby(state.rows(), key=lambda row: row[0]):
        label, number, count = codes[participant], 0, 0
        for session, rows in groupby(sessions, key=lambda row: row[1]):
            scans = list(_scans(rows))
            number, count = number + 1, count + len(scans)
            stem = f"sub-{label}/ses-{session}/sub-{label}_ses-{session}_scans"
            with put(f"{stem}.tsv") as file:
                file.writelines(line.encode() for line in tsv(SCANS, scans))
            _json(put, f"{stem}.json", SCANS)
        people.append({"participant_id": f"sub-{label}", "code": participant, "sessions": number, "recordings": count})
    with put("participants.tsv") as file:
        file.writelines(line.encode() for line in tsv(PARTICIPANTS, people))
    _json(put, "participants.json", PARTICIPANTS)
    made_by = [{"Name": "stimrig", "Version": software_version()}]
    _json(put, "dataset_description.json", {**DESCRIPTION, "GeneratedBy": made_by})
    for name, text in (("README", README), (".bidsignore", f"{ERRORS}\n{FOLDER}/\n")):
        with put(name) as file:
            file.write(text.encode())


def _scans(rows: Iterable[tuple[str, str, dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    for _, _, row in sorted(rows, key=lambda row: str(row[2]["begun_utc"])):
        begun = row["begun_utc"]
        yield {**row, "filename": row["file"], "acq_time": begun and begun.replace("+00:00", "Z")}


def grid(record: WholeRecord) -> tuple[float, float, np.ndarray, bool]:
    """Rate (Hz), start (s), each sample's place on the even grid, and whether the grid gives the times back.

    Raises NoExport: the samples lie on no even grid, or it would be longer than any record.
    """
    time_s = record.samples["time_s"]
    rate_hz, start_s = record.sample_rate_hz, float(time_s[0])
    if (time_s[-1] - start_s) * rate_hz > MOST_ROWS:
        raise NoExport(
            "not even", f"{(time_s[-1] - start_s) / 3600:.0f} h with its pauses: too long for one even table"
        )
    at = np.round((time_s - start_s) * rate_hz).astype(np.int64)
    if np.any(np.diff(at) < 1):
        raise NoExport("not even", "its samples are not even: two of them fall on one place of an even grid")
    exact = bool(np.max(np.abs(start_s + at / rate_hz - time_s)) < EVEN_S)
    return rate_hz, start_s, at, exact


def events(record: WholeRecord) -> list[dict[str, Any]]:
    """Segments and pulses in the order of their onsets."""
    found: list[dict[str, Any]] = [
        {"onset": start_s, "duration": end_s - start_s, "trial_type": "segment", "segment": name}
        for name, start_s, end_s in record.segments
    ]
    columns = {name: column.tolist() for name, column in record.pulses.items()}
    planned_s = columns.get("planned_time_s", [])
    segments = segment_at(record, np.array(planned_s)) if planned_s else []
    nothing = [float("nan")] * len(planned_s)
    for index, due_s in enumerate(planned_s):
        row = {name: columns.get(name, nothing)[index] for name in columns}
        status = row.get("status", float("nan"))
        if status == STATUS.index("rest"):
            continue
        sent = row.get("written_time_s", due_s) == row.get("written_time_s", due_s)
        place = segments[index]
        found.append({
            "onset": row.get("written_time_s", due_s) if sent else due_s,
            "duration": 0,
            "trial_type": "pulse" if sent else "pulse_not_sent",
            "segment": record.segments[place][0] if place >= 0 else None,
            "pulse_index": index,
            **{name: row.get(column) for name, column in PULSE.items()},
            "status": STATUS[int(status)] if status in range(len(STATUS)) else None,
        })  # fmt: skip
    return sorted(found, key=lambda event: (event["onset"], event["trial_type"] != "segment"))


def cell(value: Any) -> str:
    """A value as BIDS writes it; numbers as short as they can be read back unchanged; texts as texts."""
    if value is None or value != value:
        return "n/a"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return cell_text(" ".join(str(value).split())) or "n/a"


def tsv(columns: Iterable[str], rows: Iterable[dict[str, Any]]) -> Iterator[str]:
    columns = list(columns)
    yield "\t".join(columns) + "\n"
    for row in rows:
        yield "\t".join(cell(row.get(name)) for name in columns) + "\n"


def _described(words: dict[str, dict[str, Any]], names: list[str]) -> dict[str, Any]:
    return {"Columns": names, **{name: words[name] for name in names}}


def _json(put: Put, place: str, content: dict[str, Any]) -> None:
    with put(place) as file:
        file.write((json.dumps(content, ensure_ascii=False, indent=2) + "\n").encode())

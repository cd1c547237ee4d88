"""REDCap: `data_dictionary.csv` (the form) and `import.csv` (a row a test), for a project's own import.

A participant is a record, a test an instance of the repeating form `stimrig_test`; its number stays when others come.
No recording goes to REDCap: it keeps figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from stimrig.api.cohort.export import Put, Who
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.select import LABELS
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.exchange.outward import _figures
from stimrig.api.exchange.outward.parquet import record_row
from stimrig.identify.records.cells import lines

NAME: str = "redcap"
FORM = "stimrig_test"
PERSON = "stimrig_participant"
DICTIONARY = (
    "Variable / Field Name", "Form Name", "Section Header", "Field Type", "Field Label",
    "Choices, Calculations, OR Slider Labels", "Field Note", "Text Validation Type OR Show Slider Number",
    "Text Validation Min", "Text Validation Max", "Identifier?", "Branching Logic (Show field only if...)",
    "Required Field?", "Custom Alignment", "Question Number (surveys only)", "Matrix Group Name", "Matrix Ranking?",
    "Field Annotation",
)  # fmt: skip
"""REDCap's columns."""


class Field(NamedTuple):
    """A field of the form."""

    name: str
    label: str
    validation: str = ""
    note: str = ""
    choices: tuple[str, ...] = ()  # each is its own code and label
    lowest: str = ""
    identifier: str = ""
    form: str = FORM

    def row(self) -> list[str]:
        """As a line of the dictionary."""
        kind, listed = ("dropdown", " | ".join(f"{one}, {one.replace('_', ' ')}" for one in self.choices))
        made = {
            "Variable / Field Name": self.name, "Form Name": self.form, "Field Label": self.label,
            "Field Type": kind if self.choices else "text", "Field Note": self.note, "Identifier?": self.identifier,
            "Choices, Calculations, OR Slider Labels": listed, "Text Validation Min": self.lowest,
            "Text Validation Type OR Show Slider Number": self.validation,
        }  # fmt: skip
        return [made.get(column, "") for column in DICTIONARY]


VERDICTS = ("usable", "usable_with_care", "not_usable", "no_model")
FIELDS = (
    Field("record_id", "Participant's code", identifier="y", form=PERSON),
    Field("recording_id", "Recording"),
    Field("session_label", "Session", note="day of the test (UTC), or the label in its place"),
    Field("begun", "Begun", "datetime_seconds_ymd", "UTC; empty where days are hidden"),
    *(Field(f"label_{name}", label.says[:1].upper() + label.says[1:]) for name, label in LABELS.items()
      if name != "participant"),
    Field("outcome", "Outcome", choices=("completed", "stopped", "fault")),
    Field("duration_s", "Duration", "number", "s", lowest="0"),
    Field("samples", "Torque samples", "integer", lowest="0"),
    Field("pulses", "Planned pulses", "integer", lowest="0"),
    Field("pulse_rate_hz", "Pulse rate", "number", "pulses/s", lowest="0"),
    Field("current_ma", "Current", "number", "mA", lowest="0"),
    Field("torque_range_nm", "Largest less smallest torque", "number", "N·m", lowest="0"),
    Field("verdict", "Plain model", choices=VERDICTS),
    Field("no_model_reason", "Why there is no model"),
    *(Field(one.name, one.says[:1].upper() + one.says[1:], "number", one.unit) for one in _figures.FIGURES),
    Field("sha256", "SHA-256 of the file"),
)  # fmt: skip

UNVERIFIED = 1
"""Of a form in REDCap: nobody has looked at the figures yet."""


def write(record: WholeRecord, who: Who, _put: Put) -> dict[str, Any]:
    """The record's row; its figures are fitted now."""
    row, found = record_row(record, who), _figures.fitted(record)
    verdict = found.pop("verdict").replace(" ", "_")
    known = verdict in VERDICTS
    torque_nm = record.samples["torque_nm"]
    values = {
        **row,
        **found,
        **{f"label_{name}": row.get(name) for name in LABELS},
        "record_id": who.participant,
        "recording_id": who.record_id,
        "session_label": who.session,
        "begun": who.begun_utc and who.begun_utc[:19].replace("T", " "),
        "torque_range_nm": float(torque_nm.max() - torque_nm.min()),
        "verdict": verdict if known else "no_model",
        "no_model_reason": None if known else verdict.replace("_", " ").removeprefix("no model: "),
    }
    return {"fields": {field.name: values.get(field.name) for field in FIELDS}}


def finish(state: State, put: Put) -> None:
    """The dictionary and the table to import."""
    _table(put, "data_dictionary.csv", [DICTIONARY, *(field.row() for field in FIELDS)])
    first, *others = (field.name for field in FIELDS)
    header = (first, "redcap_repeat_instrument", "redcap_repeat_instance", *others, f"{FORM}_complete")
    found: list[tuple[Any, ...]] = []
    for participant, _, row in state.rows():
        values = row["fields"]
        number = state.number(participant, values["recording_id"])
        found.append((participant, FORM, number, *(values[name] for name in others), UNVERIFIED))
    _table(put, "import.csv", [header, *sorted(found, key=lambda row: (row[0], row[2]))])


def _table(put: Put, name: str, rows: Sequence[Sequence[Any]]) -> None:
    with put(name) as file:
        file.writelines(line.encode() for line in lines(rows))

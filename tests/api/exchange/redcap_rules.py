"""REDCap's rules for a data dictionary and for an import, written down from its manual: what breaks them, in words."""

from __future__ import annotations

import csv
import re
from datetime import datetime
from pathlib import Path

COLUMNS = [
    "Variable / Field Name", "Form Name", "Section Header", "Field Type", "Field Label",
    "Choices, Calculations, OR Slider Labels", "Field Note", "Text Validation Type OR Show Slider Number",
    "Text Validation Min", "Text Validation Max", "Identifier?", "Branching Logic (Show field only if...)",
    "Required Field?", "Custom Alignment", "Question Number (surveys only)", "Matrix Group Name", "Matrix Ranking?",
    "Field Annotation",
]  # fmt: skip
TYPES = {"text", "notes", "radio", "dropdown", "calc", "file", "checkbox", "yesno", "truefalse", "descriptive",
         "slider"}  # fmt: skip
CHOSEN = {"radio", "dropdown", "checkbox"}
VALIDATIONS = {
    "number": lambda text: float(text),
    "integer": lambda text: int(text),
    "date_ymd": lambda text: datetime.strptime(text, "%Y-%m-%d"),
    "datetime_seconds_ymd": lambda text: datetime.strptime(text, "%Y-%m-%d %H:%M:%S"),
}  # fmt: skip
NAME = re.compile(r"[a-z](?:[a-z0-9]|_(?!_))*[a-z0-9]|[a-z]")
RESERVED = {"redcap_event_name", "redcap_repeat_instrument", "redcap_repeat_instance", "redcap_data_access_group"}
LONGEST_NAME = 100


def rows_of(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    return list(reader.fieldnames or []), rows


def broken_in_dictionary(path: Path) -> list[str]:
    """What REDCap would refuse in a data dictionary."""
    header, rows = rows_of(path)
    found = [] if header == COLUMNS else [f"columns: {header}"]
    names = [row[COLUMNS[0]] for row in rows]
    found += [f"twice: {name}" for name in set(names) if names.count(name) > 1]
    forms = [row["Form Name"] for row in rows]
    changes = [form for index, form in enumerate(forms) if index == 0 or forms[index - 1] != form]
    found += [f"a form in pieces: {form}" for form in set(changes) if changes.count(form) > 1]
    for row in rows:
        name, kind, choices = row[COLUMNS[0]], row["Field Type"], row[COLUMNS[5]]
        if not NAME.fullmatch(name) or len(name) > LONGEST_NAME or name in RESERVED:
            found.append(f"a name: {name}")
        if not NAME.fullmatch(row["Form Name"]):
            found.append(f"a form: {row['Form Name']}")
        if kind not in TYPES or not row["Field Label"].strip():
            found.append(f"{name}: type {kind!r}, label {row['Field Label']!r}")
        if (kind in CHOSEN) != bool(choices):
            found.append(f"{name}: choices of a {kind}")
        coded = [one.partition(",")[0].strip() for one in choices.split("|")] if choices else []
        if len(set(coded)) < len(coded) or any(not re.fullmatch(r"[A-Za-z0-9_]+", one) for one in coded):
            found.append(f"{name}: codes {coded}")
        validation = row[COLUMNS[7]]
        if validation and (kind != "text" or validation not in VALIDATIONS):
            found.append(f"{name}: validation {validation!r} of a {kind}")
        if (row["Text Validation Min"] or row["Text Validation Max"]) and not validation:
            found.append(f"{name}: bounds without a validation")
        if row["Identifier?"] not in ("", "y") or row["Required Field?"] not in ("", "y"):
            found.append(f"{name}: a flag that is not y")
    return found


def broken_in_import(path: Path, dictionary: Path) -> list[str]:
    """What REDCap would refuse in a table to import into a project of that dictionary."""
    fields = {row[COLUMNS[0]]: row for row in rows_of(dictionary)[1]}
    header, rows = rows_of(path)
    first = next(iter(fields))
    forms = {row["Form Name"] for row in fields.values()}
    known = {*fields, *RESERVED, *(f"{form}_complete" for form in forms)}
    found = [f"an unknown column: {name}" for name in header if name not in known]
    if header[0] != first or len(set(header)) < len(header):
        found.append(f"columns: {header}")
    keys = [(row[first], row["redcap_repeat_instrument"], row["redcap_repeat_instance"]) for row in rows]
    if len(set(keys)) < len(keys):
        found.append("two rows of one instance")
    for row in rows:
        if (
            row["redcap_repeat_instrument"] not in forms
            or not row["redcap_repeat_instance"].isdigit()
            or not row[first]
        ):
            found.append(f"an instance: {row}")
        for name, value in row.items():
            if name in fields and value:
                found += broken_value(fields[name], name, value)
            if name.endswith("_complete") and value not in ("0", "1", "2"):
                found.append(f"{name}: {value}")
    return found


def broken_value(field: dict[str, str], name: str, value: str) -> list[str]:
    coded = [one.partition(",")[0].strip() for one in field[COLUMNS[5]].split("|")]
    if field["Field Type"] in CHOSEN and value not in coded:
        return [f"{name}: {value!r} is none of {coded}"]
    if check := VALIDATIONS.get(field[COLUMNS[7]]):
        try:
            found = check(value)
        except ValueError:
            return [f"{name}: {value!r} is no {field[COLUMNS[7]]}"]
        lowest = field["Text Validation Min"]
        if lowest and isinstance(found, int | float) and found < float(lowest):
            return [f"{name}: {value} is below {lowest}"]
    return []

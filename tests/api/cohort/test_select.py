"""`--select`: what is meant, what is not known yet, what is refused, and that nothing is ever run."""

from __future__ import annotations

import pytest

from stimrig.api.cohort.select import FIELDS, Selection
from stimrig.api.cohort.tasks import CohortError

RECORD = {
    "participant": "P001", "day": "2026-03-01", "kind": "pre-session", "rig": None, "name": "a calib.h5",
    "duration_s": 22.7, "bytes": 1000,
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("", True),
        ('participant == "P001"', True),
        ('participant in ("P001", "P002") and kind == "pre-session"', True),
        ('participant not in ["P001"]', False),
        ('participant != "P002"', True),
        ('day >= "2026-01-01" and day < "2026-03-01"', False),
        ('"2026-01-01" <= day', True),
        ("duration_s > 20 or bytes > 10", True),
        ("not (duration_s > 20)", False),
        ("20 < duration_s", True),
        ("duration_s > -1.5", True),
        ('"calib" in name', True),
        ('"calib" not in name', False),
        ("rig == None", True),
        ('rig == "R1"', False),
        ('rig != "R1"', True),
        ('rig > "R1"', False),
        ('"R" in rig', False),
        ('kind == "x" or participant == "P001" and bytes < 1', False),
        ('not kind == "x" and participant\n  == "P001"', True),
    ],
)
def test_what_is_meant(text: str, meant: bool) -> None:
    assert Selection(text)(RECORD) is meant


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ('participant == "P001"', None),
        ('not participant == "P001"', None),
        ('name == "b" and participant == "P001"', False),
        ('name == "a" or participant == "P001"', True),
        ('name == "a" and participant == "P001"', None),
        ('name == "b" or participant == "P001"', None),
    ],
)
def test_what_is_open_before_the_record_is_read(text: str, meant: bool | None) -> None:
    assert Selection(text)({"name": "a"}) is meant


def refused(text: str) -> str:
    with pytest.raises(CohortError) as caught:
        Selection(text)
    message = str(caught.value)
    assert "\n" not in message and message.startswith("--select")
    return message


def test_a_wrong_field_is_named_and_all_fields_are() -> None:
    message = refused('patient == "P001"')
    assert "'patient'" in message
    assert all(field in message for field in FIELDS)


@pytest.mark.parametrize(
    "text",
    [
        '__import__("os").system("true")',
        'participant.__class__ == "x"',
        "().__class__.__bases__[0].__subclasses__()",
        '(lambda: participant)() == "x"',
        'participant == f"{1}"',
        '[x for x in "ab"] == participant',
        'participant == open("x")',
        'participant if True else "x"',
        "(participant := 3)",
        'participant["x"] == "y"',
        "9**9**9 > bytes",
        '"a" * 999999999 == name',
        "bytes == 1 == 1",
        "participant is None",
        "participant",
        '"a" == "b"',
        "participant == kind",
        "participant == True",
        "participant == 1",
        'duration_s > "20"',
        "duration_s in 3",
        "20 in duration_s",
        'day == "yesterday"',
        'day >= "2026-02-31"',
        "rig > None",
        "bytes > 1j",
        "import os",
        "participant = 3",
        'participant == "P001"; import os',
        'participant == "P001',
        "participant == \0",
        "((((" * 500,
        "(" * 190 + 'participant == "P"' + ")" * 150,
        "not " * 400 + 'participant == "P"',
        "bytes > " + "-" * 1500 + "1",
        'participant == "P" or ' * 90 + "x",
        'participant == "' + "x" * 3000 + '"',
        "*participant",
        "await participant",
        'participant in {"a": 1}',
    ],
)
def test_what_is_no_comparison_of_fields_is_refused_in_one_line(text: str) -> None:
    refused(text)


def test_what_holds_in_any_case_is_asked_of_a_centre() -> None:
    text = 'participant == "P001" and day >= "2026-01-01" and (rig == "R1" or rig == "R2") and "2026-02-01" > day'
    assert Selection(text).hints == {"participant": "P001", "from": "2026-01-01", "to": "2026-02-01"}
    assert Selection('participant == "P001" or rig == "R1"').hints == {}
    assert Selection('not participant == "P001"').hints == {}

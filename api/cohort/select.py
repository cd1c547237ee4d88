"""The fields of a record, and `--select`: an expression over them that is parsed, never evaluated by Python.

participant in ("P001", "P002") and kind == "pre-session" and day >= "2026-01-01" and not duration_s < 20
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from typing import Any, Literal

from stimrig.api.cohort.errors import CohortError
from stimrig.rig.messages import Labels


@dataclass(frozen=True)
class Field:
    """A field: its type, meaning and unit, and the attribute of a sealed recording that it repeats."""

    type: Literal["text", "number", "day"]
    description: str
    unit: str = ""
    attribute: str = ""


LABELS = {name: Field("text", field.description or "", "", name) for name, field in Labels.model_fields.items()}
PARTICIPANT = LABELS.pop("participant")
"""Labels of a test, as its recording repeats them; the participant stands apart."""
FIELDS: dict[str, Field] = {
    "participant": PARTICIPANT,
    "day": Field("day", "day of the session, UTC"),
    **LABELS,
    "name": Field("text", "name of the file"),
    "origin": Field("text", "the DATA in which it was found"),
    "record_id": Field("text", "id of the recording, where it says one", "", "recording_id"),
    "test_id": Field("text", "id of the test", "", "test_id"),
    "outcome": Field("text", "how the test ended: completed, stopped, fault", "", "outcome"),
    "duration_s": Field("number", "from the first sample to the last", "s"),
    "rate_hz": Field("number", "samples a second", "Hz"),
    "bytes": Field("number", "size of the file", "B"),
}
"""Every field that `--select` may name. A field is absent from a mapping as long as it is unknown, and None where the
record says nothing of it."""
EXAMPLE = 'Give something like participant == "P001" and duration_s > 20.'
MAX_CHARACTERS = 2000
Condition = Callable[[Mapping[str, Any]], bool | None]


def _if_given(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    return lambda content, value: content is not None and compare(content, value)


COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: _if_given(operator.lt), ast.LtE: _if_given(operator.le),
    ast.Gt: _if_given(operator.gt), ast.GtE: _if_given(operator.ge),
}  # fmt: skip


class Selection:
    """Select records by an expression; an empty one selects all.

    Raises CohortError: it is no such expression, or names an unknown field.
    """

    def __init__(self, text: str = "") -> None:
        self.text = " ".join(text.split())
        if len(self.text) > MAX_CHARACTERS:
            raise CohortError(f"--select: more than {MAX_CHARACTERS} characters. Give a folder of the records instead.")
        self._condition: Condition = lambda _fields: True
        try:
            if self.text:
                self._condition = _condition(ast.parse(self.text, mode="eval").body)
        except SyntaxError as error:
            where = f", character {error.offset}" if error.offset else ""
            raise CohortError(f"--select{where}: {error.msg}. {EXAMPLE}") from None
        except (ValueError, RecursionError, MemoryError):  # a NUL; hundreds of brackets
            raise CohortError(f"--select: cannot be parsed. {EXAMPLE}") from None

    def __call__(self, fields: Mapping[str, Any]) -> bool | None:
        """Return whether a record is selected; None while a field that decides it is unknown."""
        return self._condition(fields)


def parse_day(text: str) -> date | None:
    """Return the day of a date or time in ISO 8601; None if it is neither."""
    try:
        return date.fromisoformat(text[:10])
    except ValueError:
        return None


def _refusal(node: ast.AST, reason: str) -> CohortError:
    return CohortError(f"--select, character {getattr(node, 'col_offset', 0) + 1}: {reason}. {EXAMPLE}")


def _condition(node: ast.expr) -> Condition:
    match node:
        case ast.BoolOp(op=op, values=values):
            return _joined([_condition(value) for value in values], decisive=isinstance(op, ast.Or))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            inner = _condition(operand)
            return lambda fields: None if (selected := inner(fields)) is None else not selected
        case ast.Compare(left=ast.Name() as name, ops=[ast.In() | ast.NotIn() as op], comparators=[choices]):
            if not isinstance(choices, ast.Tuple | ast.List | ast.Set):
                raise _refusal(choices, 'after `in` stands a list, as participant in ("P001", "P002")')
            values = {_value(name, item) for item in choices.elts}
            return _of_field(name, lambda content: (content in values) is isinstance(op, ast.In))
        case ast.Compare(left=part, ops=[ast.In() | ast.NotIn() as op], comparators=[ast.Name() as name]):
            text = _literal(part)
            if not isinstance(text, str) or _field(name).type == "number":
                raise _refusal(node, "`in` looks for a text in quotes within a text")
            return _of_field(
                name, lambda content: (content is not None and text in str(content)) is isinstance(op, ast.In)
            )
        case ast.Compare(left=ast.Name() as name, ops=[op], comparators=[right]) if type(op) in COMPARISONS:
            compare, value = COMPARISONS[type(op)], _value(name, right)
            if value is None and not isinstance(op, ast.Eq | ast.NotEq):
                raise _refusal(right, "None has no order; compare with == or !=")
            return _of_field(name, lambda content: compare(content, value))
    raise _refusal(node, "only comparisons of a field, on their left, and, or, not and brackets can be used")


def _joined(conditions: list[Condition], decisive: bool) -> Condition:
    """Join by `or` (decisive: True) or `and` (False); unknown where none is decisive and one is unknown."""

    def condition(fields: Mapping[str, Any]) -> bool | None:
        results = [test(fields) for test in conditions]
        if decisive in results:
            return decisive
        return None if None in results else not decisive

    return condition


def _of_field(name: ast.Name, test: Callable[[Any], bool]) -> Condition:
    _field(name)
    return lambda fields: test(fields[name.id]) if name.id in fields else None


def _field(name: ast.Name) -> Field:
    if name.id not in FIELDS:
        raise CohortError(f"--select: there is no field {name.id!r}. There are {', '.join(FIELDS)}.")
    return FIELDS[name.id]


def _value(name: ast.Name, node: ast.expr) -> Any:
    """Return the literal with which a field is compared; a day as a date."""
    kind = _field(name).type
    value: Any = _literal(node)
    if value is None:
        return None
    if kind == "number" and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise _refusal(node, f"{name.id} is a number")
    if kind != "number" and not isinstance(value, str):
        raise _refusal(node, f"{name.id} is a text: write it in quotes")
    if kind == "day":
        day = parse_day(str(value))
        if day is None or day.isoformat() != value:
            raise _refusal(node, f"{name.id} is a day, as 2026-01-31")
        return day
    return value


def _literal(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        raise _refusal(node, "only a text in quotes, a number or None can stand here") from None

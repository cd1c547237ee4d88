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
ORDERED: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
}  # fmt: skip
WITHIN: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.In: lambda part, whole: part in whole,
    ast.NotIn: lambda part, whole: whole is None or part not in whole,
}
COMPARISONS = {ast.Eq: operator.eq, ast.NotEq: operator.ne, **ORDERED, **WITHIN}


class Selection:
    """Select records by an expression; an empty one selects all.

    Raises CohortError: it is no such expression, or names an unknown field.
    """

    def __init__(self, text: str = "") -> None:
        self.text = " ".join(text.split())
        if len(self.text) > MAX_CHARACTERS:
            raise CohortError(f"--select: more than {MAX_CHARACTERS} characters. Give a folder of the records instead.")
        try:
            self._tree = ast.parse(self.text, mode="eval").body if self.text else None
            if self._tree is not None:
                _check(self._tree)
        except SyntaxError as error:
            where = f", character {error.offset}" if error.offset else ""
            raise CohortError(f"--select{where}: {error.msg}. {EXAMPLE}") from None
        except (ValueError, RecursionError, MemoryError):  # a NUL; hundreds of brackets
            raise CohortError(f"--select: cannot be parsed. {EXAMPLE}") from None

    def __call__(self, fields: Mapping[str, Any]) -> bool | None:
        """Return whether a record is selected; None while a field that decides it is unknown."""
        return self._tree is None or _evaluate(self._tree, fields)


def parse_day(text: str) -> date | None:
    """Return the day of a date or time in ISO 8601; None if it is neither."""
    try:
        return date.fromisoformat(text[:10])
    except ValueError:
        return None


def _refusal(node: ast.AST, reason: str) -> CohortError:
    return CohortError(f"--select, character {getattr(node, 'col_offset', 0) + 1}: {reason}. {EXAMPLE}")


def _check(node: ast.expr) -> None:
    """Raise CohortError unless `_evaluate` knows all that the expression holds."""
    match node:
        case ast.BoolOp(values=values):
            for value in values:
                _check(value)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            _check(operand)
        case ast.Compare(left=ast.Name() as name, ops=[ast.In() | ast.NotIn()], comparators=[choices]):
            if not isinstance(choices, ast.Tuple | ast.List | ast.Set):
                raise _refusal(choices, 'after `in` stands a list, as participant in ("P001", "P002")')
            for item in choices.elts:
                _check_literal(name, item)
        case ast.Compare(left=part, ops=[ast.In() | ast.NotIn()], comparators=[ast.Name() as name]):
            if not isinstance(_literal(part), str) or _field(name).type == "number":
                raise _refusal(node, "`in` looks for a text in quotes within a text")
        case ast.Compare(left=ast.Name() as name, ops=[op], comparators=[right]) if type(op) in COMPARISONS:
            _check_literal(name, right)
            if type(op) in ORDERED and _literal(right) is None:
                raise _refusal(right, "None has no order; compare with == or !=")
        case _:
            raise _refusal(node, "only comparisons of a field, on their left, and, or, not and brackets can be used")


def _check_literal(name: ast.Name, node: ast.expr) -> None:
    """Raise CohortError unless a field can be compared with the literal."""
    kind, value = _field(name).type, _literal(node)
    if value is None:
        return
    if kind == "number" and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise _refusal(node, f"{name.id} is a number")
    if kind != "number" and not isinstance(value, str):
        raise _refusal(node, f"{name.id} is a text: write it in quotes")
    if kind == "day" and str(parse_day(str(value))) != value:
        raise _refusal(node, f"{name.id} is a day, as 2026-01-31")


def _field(name: ast.Name) -> Field:
    if name.id not in FIELDS:
        raise CohortError(f"--select: there is no field {name.id!r}. There are {', '.join(FIELDS)}.")
    return FIELDS[name.id]


def _literal(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        raise _refusal(node, "only a text in quotes, a number or None can stand here") from None


def _evaluate(node: Any, fields: Mapping[str, Any]) -> bool | None:
    """Return what an expression gives; None where a field is unknown that decides it."""
    if isinstance(node, ast.BoolOp):
        decisive, results = isinstance(node.op, ast.Or), [_evaluate(value, fields) for value in node.values]
        return decisive if decisive in results else None if None in results else not decisive
    if isinstance(node, ast.UnaryOp):
        inner = _evaluate(node.operand, fields)
        return None if inner is None else not inner
    sides: list[Any] = []
    for side in (node.left, node.comparators[0]):
        if isinstance(side, ast.Name) and side.id not in fields:
            return None
        value = fields[side.id] if isinstance(side, ast.Name) else ast.literal_eval(side)
        sides.append(value.isoformat() if isinstance(value, date) else value)
    try:
        return COMPARISONS[type(node.ops[0])](*sides)
    except TypeError:  # None has no order and holds nothing
        return False

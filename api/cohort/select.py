"""`--select`: a small expression over the fields of a record. It is parsed and walked, never evaluated by Python.

    participant in ("P001", "P002") and kind == "pre-session" and day >= "2026-01-01" and not duration_s < 20

Comparisons (`==`, `!=`, `<`, `<=`, `>`, `>=`, `in`, `not in`) between a field and texts or numbers, joined by `and`,
`or`, `not` and brackets. `"calib" in name` asks for a part of a text, `rig == None` for a field that is not given.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from typing import Any, Literal

from stimrig.api.cohort.tasks import CohortError
from stimrig.rig.messages import Labels

Type = Literal["text", "number", "day"]


@dataclass(frozen=True)
class Field:
    """One field: its type, what it says, its unit, and the attribute of a sealed recording that it repeats."""

    type: Type
    says: str
    unit: str = ""
    attribute: str = ""


LABELS = {name: Field("text", about.description or "", "", name) for name, about in Labels.model_fields.items()}
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

Known = Mapping[str, Any]


def as_day(value: str) -> str | None:
    """A day as `YYYY-MM-DD`, of a day or a time in ISO 8601; None where it is none."""
    try:
        return date.fromisoformat(value[:10]).isoformat()
    except ValueError:
        return None


LONGEST = 2000
"""Characters."""
DEEPEST = 50
"""Levels of the parsed expression."""
MIRRORED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE, ast.Eq: ast.Eq, ast.NotEq: ast.NotEq,
}  # fmt: skip
Test = Callable[[Known], bool | None]


class Selection:
    """Which records are meant.

    `text`: the expression; empty: all. Raises CohortError: it is no such expression, or names a field that there is
    not.
    """

    def __init__(self, text: str = "") -> None:
        self.text = " ".join(text.split())
        self._test: Test = lambda _known: True
        if self.text:
            self._test = _test(_parsed(self.text))

    def __call__(self, known: Known) -> bool | None:
        """Whether a record is meant; None while fields that decide it are not known yet."""
        return self._test(known)


def _parsed(text: str) -> ast.expr:
    if len(text) > LONGEST:
        raise CohortError(f"--select: {len(text)} characters. At most {LONGEST}; give a folder of the records instead.")
    try:
        tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        where = f", character {error.offset}" if error.offset else ""
        raise CohortError(f"--select{where}: {error.msg}. {EXAMPLE}") from None
    except (ValueError, RecursionError, MemoryError):  # a NUL; more brackets than anybody types
        raise CohortError(f"--select: cannot be read. {EXAMPLE}") from None
    if _depth(tree) > DEEPEST:
        raise CohortError(f"--select: more than {DEEPEST} levels of brackets, not and -. {EXAMPLE}")
    return tree


def _depth(tree: ast.AST) -> int:
    """How deep the tree is, found without going down by calls."""
    level, depth = [tree], 0
    while level and depth <= DEEPEST:
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        depth += 1
    return depth


EXAMPLE = 'Give something like participant == "P001" and duration_s > 20.'


def _bad(node: ast.AST, says: str) -> CohortError:
    at = getattr(node, "col_offset", 0) + 1
    return CohortError(f"--select, character {at}: {says}. {EXAMPLE}")


def _test(node: ast.expr) -> Test:
    if isinstance(node, ast.BoolOp):
        tests = [_test(value) for value in node.values]
        return _joined(tests, isinstance(node.op, ast.And))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        inner = _test(node.operand)
        return lambda known: None if (found := inner(known)) is None else not found
    if isinstance(node, ast.Compare):
        return _comparison(node)
    raise _bad(node, "only comparisons, and, or, not and brackets can be used")


def _joined(tests: list[Test], every: bool) -> Test:
    """`and` (every) or `or`: decided by one that decides, unknown where none does and one is unknown."""

    def test(known: Known) -> bool | None:
        found = [one(known) for one in tests]
        if (not every) in found:
            return not every
        return None if None in found else every

    return test


def _comparison(node: ast.Compare) -> Test:
    field, kind, value = _sides(node)
    compare = TESTS[kind]
    return lambda known: compare(known[field], value) if field in known else None


class Contains(ast.cmpop):
    """A text within a field's."""


class ContainsNot(ast.cmpop):
    """A text not within a field's."""


def _ordered(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    return lambda given, value: given is not None and compare(given, value)


TESTS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: _ordered(operator.lt), ast.LtE: _ordered(operator.le),
    ast.Gt: _ordered(operator.gt), ast.GtE: _ordered(operator.ge), ast.In: lambda given, value: given in value,
    ast.NotIn: lambda given, value: given not in value, Contains: _ordered(lambda given, value: value in given),
    ContainsNot: lambda given, value: given is None or value not in given,
}  # fmt: skip
"""What each comparison asks of a field's value."""


def _sides(node: ast.Compare) -> tuple[str, type[ast.cmpop], Any]:
    """Field, comparison and value, the field on the left."""
    if len(node.ops) != 1:
        raise _bad(node, "one comparison at a time; join several by and")
    left, right, kind = node.left, node.comparators[0], type(node.ops[0])
    if isinstance(left, ast.Name) == isinstance(right, ast.Name):
        raise _bad(node, "a field is compared with a text or a number")
    name, other = (left, right) if isinstance(left, ast.Name) else (right, left)
    assert isinstance(name, ast.Name)
    field = _field(name)
    if kind in (ast.In, ast.NotIn):
        return (field, kind, _several(field, other)) if name is left else _part_of(node, field, other)
    if kind not in MIRRORED:
        raise _bad(node, "compare with ==, !=, <, <=, >, >=, in or not in")
    return field, kind if name is left else MIRRORED[kind], _value(field, other, kind)


def _part_of(node: ast.Compare, field: str, given: ast.expr) -> tuple[str, type[ast.cmpop], str]:
    if FIELDS[field].type == "number":
        raise _bad(node, f"{field} is a number, and nothing is part of it")
    part = _literal(given)
    if not isinstance(part, str):
        raise _bad(given, "a text is part of a text")
    return field, Contains if isinstance(node.ops[0], ast.In) else ContainsNot, part


def _field(node: ast.Name) -> str:
    if node.id not in FIELDS:
        raise CohortError(f"--select: there is no field {node.id!r}. There are {', '.join(FIELDS)}.")
    return node.id


def _several(field: str, node: ast.expr) -> frozenset[Any]:
    if not isinstance(node, ast.Tuple | ast.List | ast.Set):
        raise _bad(node, f'after in stands a list, as {field} in ("A", "B")')
    return frozenset(_value(field, item, ast.Eq) for item in node.elts)


def _value(field: str, node: ast.expr, kind: type[ast.cmpop]) -> Any:
    """A literal that suits the field."""
    value, type_ = _literal(node), FIELDS[field].type
    if value is None:
        if kind not in (ast.Eq, ast.NotEq):
            raise _bad(node, f"None has no order; compare {field} by == or !=")
        return None
    if type_ == "number":
        if not isinstance(value, int | float):
            raise _bad(node, f"{field} is a number")
        return value
    if not isinstance(value, str):
        raise _bad(node, f"{field} is a text: write it in quotes")
    if type_ == "day" and as_day(value) != value:
        raise _bad(node, f"{field} is a day, as 2026-01-31")
    return value


def _literal(node: ast.expr) -> str | int | float | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _literal(node.operand)
        if isinstance(value, int | float):
            return -value
    elif isinstance(node, ast.Constant):
        value = node.value
        if value is None or (isinstance(value, str | int | float) and not isinstance(value, bool)):
            return value
    raise _bad(node, "only a text in quotes, a number or None can stand here")

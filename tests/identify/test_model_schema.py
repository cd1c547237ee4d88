"""The published schema of MODEL.json is what models are read by: the reader and a full validator say the same."""

from __future__ import annotations

import contextlib
import copy
import json
import math
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Any

import jsonschema_rs
import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.model_schema import LARGEST, LONGEST, SCHEMA, check, check_model
from tests.identify import hidden_muscles

SPOILED = (None, True, "x", -1, 0.5, 1e7, [], {}, [1.0, "x"], {"value": None})


def places(node: Any, way: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The way to each value of a document; of a list to its first and last."""
    yield way
    if isinstance(node, dict):
        for name, part in node.items():
            yield from places(part, (*way, name))
    elif isinstance(node, list) and node:
        for index in {0, len(node) - 1}:
            yield from places(node[index], (*way, index))


def changed(node: Any, way: Sequence[str | int], value: Any) -> Any:
    """With another value there; what is not on the way to it is shared, not copied."""
    first, *rest = way
    found = copy.copy(node)
    found[first] = changed(node[first], rest, value) if rest else value
    return found


def refused(document: dict[str, Any]) -> str:
    try:
        check(document, SCHEMA, "")
    except identify.BadModel as error:
        return str(error)
    return ""


def shortened(node: Any) -> Any:
    """A document with the first rows of its tables alone."""
    if isinstance(node, dict):
        return {name: shortened(part) for name, part in node.items()}
    return [shortened(part) for part in node[:3]] if isinstance(node, list) else node


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    """Of a fit with an effect."""
    found = identify.fit(hidden_muscles.record(rate_hz=100), effects=["fatigue"]).to_dict()
    joint = {"reference_angle_rad": 0.1, "angle_rad": [0.0, 1.0], "velocity_rad_s": [0.0], "g": [[1.0], [1.0]]}
    joint |= {"h_nm": [[0.0], [0.0]], "inertia_nm_s2_per_rad": 0.0, "seen_g": [[1], [2]], "seen_h": [[1], [2]]}
    return json.loads(json.dumps(found | {"joint": joint}))


@pytest.mark.parametrize("method", ["maximum-likelihood", "two-stage", "separable-least-squares", "narx"])
def test_without_a_key_a_model_predicts_the_same_or_is_refused(method: str) -> None:
    record = hidden_muscles.record(rate_hz=100)
    effects = ["free_width_by_torque", "fatigue", "output_saturation"] if method == "maximum-likelihood" else []
    document = json.loads(identify.fit(record, method=method, effects=effects).to_json())
    record = record.with_torque(0.9 * record.torque_nm)  # another one: no key says what its first torque is
    torque_nm, silent = identify.Model.from_dict(document).predict(record), []
    for *way, name in filter(None, places(document)):
        holder = reduce(lambda node, key: node[key], way, shorter := copy.deepcopy(document))
        if isinstance(holder, dict):
            del holder[name]
            with contextlib.suppress(identify.IdentifyError):
                if not np.array_equal(identify.Model.from_dict(shorter).predict(record), torque_nm):
                    silent.append((*way, name))
    assert silent == []


def as_read(node: Any) -> Any:
    """The schema with the reader's own words said in those of every validator."""
    if isinstance(node, list):
        return [as_read(part) for part in node]
    if not isinstance(node, dict):
        return node
    found = {key: as_read(part) for key, part in node.items() if not key.startswith("x-")}
    needed, also = node.get("x-needed", []), node.get("x-also", [])
    if "required" in node or needed:
        found["required"] = node["required"] if needed is True else needed
    return {"anyOf": [found, *({"type": kind} for kind in also)]} if also else found


def test_the_reader_and_a_full_validator_refuse_the_same(document: dict[str, Any]) -> None:
    document = shortened(document)
    strict, full = jsonschema_rs.validator_for(SCHEMA), jsonschema_rs.validator_for(as_read(SCHEMA))
    assert strict.is_valid(document) and refused(document) == ""
    tried, looser, differ = 0, 0, []
    for way in places(document):
        for value in SPOILED if way else ():
            spoiled = changed(document, way, value)
            tried += 1
            said, valid = refused(spoiled), full.is_valid(spoiled)
            looser += valid and not strict.is_valid(spoiled)
            if valid != (said == "" or "not strictly rising" in said):
                differ.append((way, value, said))
    assert tried > 1000 and looser > 10
    assert differ == []


@pytest.mark.parametrize(
    ("way", "value"),
    [
        (("recruitment", "torque_nm"), [0.0] * (LONGEST + 1)),
        (("reasons",), ["x"] * (LONGEST + 1)),
        (("method",), "x" * (LONGEST + 1)),
        *((("baseline_nm",), value) for value in (math.nan, math.inf, 10 * LARGEST, -math.inf, 10**400)),
        (("recruitment", "torque_nm", 0), math.nan),
        (("linear", "delay_samples"), math.inf),
        (("fit", "rms_nm"), math.nan),
    ],
)
def test_numbers_lists_and_texts_without_bounds_have_an_end(document: dict[str, Any], way: Any, value: Any) -> None:
    assert refused(changed(document, way, value)).startswith(f"{'.'.join(map(str, way))}: ")


def test_what_is_only_told_may_be_unknown(document: dict[str, Any]) -> None:
    """A number that was not finite is written as null: the model is read again all the same."""
    table = ("recruitment", "torque_nm", 0)
    band = ("uncertainty", "bands", "recruitment", "lower", 0)
    one_number = ("valid_for", "pulse_width_us")
    for way in (table, band, (*one_number, 1), one_number, ("data", "recording_id"), ("fit", "segments", 0, "end_s")):
        assert refused(changed(document, way, None)) == "", way
    assert refused(changed(document, one_number, 300.0)) == ""
    assert identify.Model.from_dict(changed(document, band, None)).bands["recruitment"]["lower"][0] is None
    for name in ("kind", "time_constant_s", "damping"):
        less = {key: value for key, value in document["linear"].items() if key != name}
        with pytest.raises(identify.BadModel, match=rf"linear\.{name}: the key is missing"):
            check_model(document | {"linear": less})
    for way in (("linear", "damping"), ("recruitment", "basis", "coefficients_nm", 0), ("baseline_nm",)):
        assert refused(changed(document, way, None)).startswith(f"{'.'.join(map(str, way))}: None is not a number")


def test_what_the_schema_cannot_say_is_checked(document: dict[str, Any]) -> None:
    for way, value, says in (
        (("joint", "g"), [[1.0]], r"joint\.g: not 2 rows of 1"),
        (("joint", "angle_rad"), [1.0, 1.0], r"joint\.angle_rad: the values are not strictly rising"),
        (("effects", 0, "parameters", "depth", "value"), None, r"effects\.0\.parameters\.depth: None is not a number"),
        (
            ("effects", 0, "settings", "angle_range_rad"),
            [1.0, 0.0],
            r"settings\.angle_range_rad: .*not strictly rising",
        ),
    ):
        with pytest.raises(identify.BadModel, match=says):
            check_model(changed(document, way, value))

"""Documents and columns as MAT files (version 5): what MATLAB and Octave load as they are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from stimrig.identify.json_text import json_value

LONGEST_NAME = 63


def write(path: Path, variables: Mapping[str, Any]) -> None:
    """Write variables as a MAT file.

    Objects become structs, lists of numbers columns, tables of numbers matrices, other lists cell arrays, null an
    empty matrix. A name that MATLAB does not take loses its other signs. Raises OSError: it cannot be written.
    """
    values = {_name(name): _value(json_value(value)) for name, value in variables.items()}
    with path.open("wb") as file:
        savemat(file, values, do_compression=True, long_field_names=True, oned_as="column")


def _value(value: Any) -> Any:
    if value is None:
        return np.zeros((0, 0))
    if isinstance(value, dict):
        return {_name(key): _value(item) for key, item in value.items()} or np.zeros((0, 0))
    if not isinstance(value, list):
        return value
    if (numbers := _numbers(value)) is not None:
        return numbers
    cells = np.empty((len(value), 1), object)
    for index, item in enumerate(value):
        cells[index, 0] = _value(item)
    return cells


def _numbers(value: list[Any]) -> np.ndarray | None:
    """A list, or a list of equally long lists, as numbers with NaN for null; None where it is something else."""
    flat = [item for row in value for item in row] if value and all(isinstance(row, list) for row in value) else value
    if not all(item is None or isinstance(item, int | float) for item in flat):
        return None
    if flat is not value and len({len(row) for row in value}) > 1:
        return None
    return np.array(value, float)


def _name(text: str) -> str:
    name = re.sub(r"\W", "_", text, flags=re.ASCII)[:LONGEST_NAME]
    return name if name[:1].isalpha() else f"x{name}"[:LONGEST_NAME]

"""Functions for several methods: rows by segment name, baseline, options."""

from __future__ import annotations

import numpy as np

from stimrig.identify.dynamics.grid import Grid, runs
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.plain import pilot
from stimrig.identify.estimation.samples import rows_of


def segment_rows(grid: Grid, names: tuple[str, ...], method_id: str) -> np.ndarray:
    """Rows of the named segments, without held-out ones. Raises NotIdentifiable: the record has no such segment."""
    there = tuple(dict.fromkeys(grid.record.segment_names))
    rows = grid.fitted & rows_of(grid, names)
    if not rows.any():
        message = f"{method_id} needs a segment {' or '.join(names)}; the record has {', '.join(there)}"
        fix = "Name the segments to use with fit_on, or use maximum-likelihood, which takes any."
        raise NotIdentifiable(message, fix=fix)
    return rows


def near_rest(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """The rows and the rests next to them, which show the baseline and the tail of the response."""
    result = rows.copy()
    rest = grid.fitted & rows_of(grid, ("rest",))
    for _ in range(2):
        for stretch in runs(rest):
            before, after = max(stretch.start - 1, 0), min(stretch.stop, grid.size - 1)
            if rows[before] or rows[after]:
                result[stretch] = True
    return result


QUIET_AFTER_S = 4.0


def quiet_level(grid: Grid) -> float:
    """Baseline at zero torque, N·m: from the time before the first pulse, else 4 s after a pulse, else that of a pilot
    fit, which knows where the muscle pulls.

    2 s after a pulse are not enough: an underdamped muscle with a time constant of 0.5 s still oscillates then.
    """
    still = grid.pulse_width_us == 0
    before = grid.fitted & np.logical_and.accumulate(still)
    if before.sum() >= 4:
        return float(np.mean(grid.torque_nm[before]))
    last_pulse = np.maximum.accumulate(np.where(still, -grid.size, np.arange(grid.size)))
    quiet = still & grid.fitted & ((np.arange(grid.size) - last_pulse) * grid.step_s > QUIET_AFTER_S)
    if quiet.sum() >= 4:
        return float(np.mean(grid.torque_nm[quiet]))
    first = pilot(grid, grid.fitted)
    return float(first.problem.setup.to_record(first.physical[first.problem.baselines.start]))


def with_past(rows: np.ndarray, lead: int) -> np.ndarray:
    """The rows of which the `lead` rows before are among them, too: all that they are regressed on was measured."""
    used = rows.copy()
    for lag in range(1, lead + 1):
        used[lag:] &= rows[:-lag]
    used[:lead] = False
    return used


def order_option(value: object) -> str | tuple[int, int, int]:
    """`second-order`, `auto`, or (l, n, d) from `2,1,1` or a sequence. Raises BadRequest: it is none of these."""
    if value in ("second-order", "auto"):
        return str(value)
    parts = value.split(",") if isinstance(value, str) else list(value) if isinstance(value, (list, tuple)) else []
    try:
        poles, zeros, delay = (int(part) for part in parts)
    except ValueError:
        poles = -1
        zeros = delay = 0
    if not (1 <= poles <= 6 and 0 <= zeros <= 6 and 0 <= delay <= 40):
        fix = "Give second-order, auto, or poles,zeros,delay such as 2,1,1."
        raise BadRequest(f"invalid order {value!r}", place="order", fix=fix)
    return poles, zeros, delay


def flag(value: object, name: str) -> bool:
    """True or False, from a bool or from text. Raises BadRequest: it is neither."""
    text = str(value).lower()
    if text not in {"true", "false", "1", "0", "yes", "no"}:
        raise BadRequest(f"invalid value {value!r}", place=name, fix="Give true or false.")
    return text in {"true", "1", "yes"}


def shifted(values: np.ndarray, by: int) -> np.ndarray:
    """Values `by` rows later, from rest."""
    return np.concatenate([np.zeros(by), values[: values.size - by]]) if by else values

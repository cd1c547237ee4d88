"""The same record as another recorder gives it: changes that change nothing about the muscle.

Each kind alone, several with `+`, or `real`: all that a clinic's recorder does at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.hidden.scenario import rng_of

KINDS = ("plain", "real", "offset", "start", "counts", "negative", "scaled", "shifted", "gap")
COUNT_NM = 0.005
SHIFT_S = 12345.678
LARGEST_OFFSET_NM = {"offset": 50.0, "real": 12.0}
CUT_S = (0.5, 3.0)
IN_CONTRACTION_S = 0.1
GAP_S = (0.3, 1.5)
APART_S = 1.0
"""Between gaps, and between a gap and the record's ends."""


def _start(record: dict[str, Any], rng: Generator) -> int:
    """A row 0.5 to 3 s past the beginning of the PRBS, the muscle stimulated there and 0.1 s before."""
    in_prbs = np.flatnonzero(record["segment"] == "prbs")
    if not in_prbs.size:
        raise ValueError("the record has no prbs segment to begin in")
    time_s, width_us = record["time_s"], record["pulse_width_us"]
    since_s = time_s[in_prbs] - time_s[in_prbs[0]]
    rows = in_prbs[(since_s >= CUT_S[0]) & (since_s <= CUT_S[1])]
    before = np.searchsorted(time_s, time_s[rows] - IN_CONTRACTION_S)
    return int(rng.choice(rows[(width_us[rows] > 0.0) & (width_us[before] > 0.0)]))


def _gaps(record: dict[str, Any], rng: Generator) -> tuple[list[list[float]], np.ndarray]:
    """Two gaps outside `validate`, as begin and length in s, and the rows that remain."""
    time_s = record["time_s"]
    remaining = np.ones(time_s.size, bool)
    held_out = record["segment"] == "validate"
    gaps: list[list[float]] = []
    for _ in range(1000):
        length_s = float(rng.uniform(*GAP_S))
        begin_s = float(rng.uniform(time_s[0] + APART_S, time_s[-1] - APART_S - length_s))
        missing = (time_s >= begin_s) & (time_s < begin_s + length_s)
        alone = all(abs(begin_s - other) > GAP_S[1] + APART_S for other, _ in gaps)
        if alone and not held_out[missing].any():
            remaining &= ~missing
            gaps.append([begin_s, length_s])
        if len(gaps) == 2:
            return sorted(gaps), remaining
    raise ValueError("the record has no room for two gaps outside validate")


def _rows_of(record: dict[str, Any], rows: Any) -> dict[str, Any]:
    """These rows of every column."""
    return {name: column[rows] for name, column in record.items()}


def recorded(original: dict[str, Any], kind: str, seed: int) -> dict[str, Any]:
    """Return the record as another recorder gives it.

    Joint angle and velocity lose the rows that torque loses and keep their values: only the load cell is turned round,
    shifted or scaled.

    Parameters
    ----------
    original
        From `bench.muscles.hidden_records.generate`; it is not changed.
    kind
        `plain`: as it is. `offset`: a zero within ±50 N·m. `start`: it begins 0.5 to 3 s into the PRBS, within a
        contraction, its time there 0. `counts`: torque in steps of 5 mN·m. `negative`: torque with the other sign.
        `scaled`: torque × 0.1 for even seeds, × 10 for odd. `shifted`: time + 12345.678 s. `gap`: 0.3 to 1.5 s
        missing twice, outside `validate`. `real`: start, counts, an offset within ±12 N·m, and negative for odd
        seeds. Several with `+`.
    seed
        Decides every random number, together with the hidden effects.

    Returns
    -------
    dict
        The columns, the same `truth`, and `recorder`: `kind`, `scale` (of torque, with its sign), `offset_nm`,
        `cut_s`, `gaps_s`.

    Raises
    ------
    ValueError
        No such kind; a record in which there is no room for it.
    """
    kinds = kind.split("+")
    for name in kinds:
        if name not in KINDS:
            raise ValueError(f"recorder {name!r}: one of {', '.join(KINDS)}")
    truth = original["truth"]
    rng = {name: rng_of(seed, "recorder", name, *truth["effects"], truth["strength"]) for name in KINDS}
    all_of_real = {"start", "counts", "offset", *(["negative"] if seed % 2 else [])} if "real" in kinds else set()
    changes = {*kinds} | all_of_real

    record = {name: column.copy() for name, column in original.items() if isinstance(column, np.ndarray)}
    recorder: dict[str, Any] = {"kind": kind, "scale": 1.0, "offset_nm": 0.0, "cut_s": 0.0, "gaps_s": []}
    if "start" in changes:
        first = _start(record, rng["start"])
        recorder["cut_s"] = float(record["time_s"][first] - record["time_s"][0])
        record = _rows_of(record, slice(first, None))
        record["time_s"] = record["time_s"] - record["time_s"][0]
    if "gap" in changes:
        recorder["gaps_s"], remaining = _gaps(record, rng["gap"])
        record = _rows_of(record, remaining)
    if "shifted" in changes:
        record["time_s"] = record["time_s"] + SHIFT_S
    size = (10.0 if seed % 2 else 0.1) if "scaled" in changes else 1.0
    recorder["scale"] = -size if "negative" in changes else size
    if "offset" in changes:
        largest = LARGEST_OFFSET_NM["offset" if "offset" in kinds else "real"]
        recorder["offset_nm"] = float(rng["offset"].uniform(-largest, largest))
    record["torque_nm"] = record["torque_nm"] * recorder["scale"] + recorder["offset_nm"]
    if "counts" in changes:
        record["torque_nm"] = np.round(record["torque_nm"] / COUNT_NM) * COUNT_NM
    return {**record, "truth": truth, "recorder": recorder}

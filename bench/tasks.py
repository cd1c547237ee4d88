"""Tasks of the contenders: a record whose rows of `validate` they predict in free run, and the unit of the error.

Muscles of the paper and of the emulator, whose equations are nobody's here. One sample a pulse, so that all see the
same rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from bench.muscles.bout_records import RAMPS, record_of_bouts
from bench.muscles.hidden_records import generate
from bench.muscles.physics_records import record_of_physics
from stimrig.identify import paper
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import as_record

RATE_HZ = 40.0


@dataclass(frozen=True)
class Task:
    """One record; rows of `validate` may not be fitted, and are scored."""

    name: str
    record: Record
    unit: str = "× noise"  # what the error is told in
    scale: float = 1.0  # one of that unit, in the record's torque
    true: bool = False  # whether it is the paper's muscle, with its five parameters

    @property
    def rate_hz(self) -> float:
        return round(self.record.sample_rate_hz, 3)

    @property
    def fitted(self) -> np.ndarray:
        """bool, shape (N,): rows that may be fitted."""
        return ~self.record.held_out

    @property
    def longest(self) -> slice:
        """The longest stretch of rows that may be fitted."""
        change = np.flatnonzero(np.diff(np.r_[False, self.fitted, False].astype(int))).reshape(-1, 2)
        return slice(*max(change.tolist(), key=np.ptp))

    @property
    def fine(self) -> bool:
        """True where it has more than one sample a pulse."""
        return self.rate_hz > 1.5 * self.record.pulse_rate_hz

    def error(self, predicted: np.ndarray) -> float:
        """Root mean square on the unseen rows, in its unit."""
        return float(np.sqrt(np.mean((predicted - self.record.torque_nm)[~self.fitted] ** 2))) / self.scale


def papers(rate_hz: float, noise_nm: float, seed: int) -> Task:
    """The paper's muscle."""
    widths, names = paper.protocol()
    clean, each = paper.torque(widths, rate_hz), round(rate_hz / RATE_HZ)
    noise = np.random.default_rng(seed).standard_normal(clean.size) * noise_nm
    labels = np.repeat(names, each)
    rows = labels.size - 40 * each  # a rest after what is to be predicted
    time_s = np.arange(clean.size) / rate_hz
    record = Record.from_arrays(time_s[:rows], np.repeat(widths, each)[:rows], (clean + noise)[:rows], labels[:rows])
    return Task(f"paper's muscle, {rate_hz:g} Hz", record, scale=noise_nm, true=True)


def emulated(effect: str | None, seed: int) -> Task:
    """A muscle of the emulator with something hidden, or nothing."""
    generated = generate(effect, "middle", seed, rate_hz=RATE_HZ)
    return Task(effect or "nothing hidden", as_record(generated), scale=generated["truth"]["noise"]["sd_nm"])


def rounded(generated: dict[str, Any]) -> dict[str, Any]:
    """Return one sample a pulse of a generated record."""
    each = round((len(generated["time_s"]) - 1) / float(generated["time_s"][-1] - generated["time_s"][0]) / RATE_HZ)
    rows = {name: generated[name][::each] for name in ("time_s", "pulse_width_us", "torque_nm", "segment")}
    return generated | rows | ({"bout": generated["bout"][::each]} if "bout" in generated else {})


def of_physics(seed: int) -> Task:
    """A muscle of other physics, with white noise alone."""
    generated = rounded(record_of_physics("physics", seed, disturbed=()))
    return Task(f"physics: {generated['truth']['kind']}", as_record(generated), scale=generated["truth"]["noise_sd_nm"])


def of_bouts(seed: int) -> Task:
    """A record as arms give them: its last ramp, in errors of the mean of the other ramps."""
    generated = rounded(record_of_bouts(seed))
    bouts = [np.flatnonzero(generated["bout"] == generated["bout"][-1] - back) for back in range(RAMPS)]
    torque = np.array([generated["torque_nm"][rows[: min(map(len, bouts))]] for rows in bouts])
    off = float(np.sqrt(np.mean((torque[0] - torque[1:].mean(axis=0)) ** 2)))
    return Task("as of an arm", as_record(generated), unit="× repetition", scale=off)


def makers(seed: int) -> Iterator[tuple[str, Callable[[], Task]]]:
    """Name and maker of each task, in the order of the table."""
    yield "paper's muscle, 40 Hz", partial(papers, 40.0, 0.02, seed)
    yield "paper's muscle, 1600 Hz", partial(papers, 1600.0, 0.02, seed)
    seed = seed % 1000 + 1000
    for effect in (None, "fatigue", "series_compliance", "pulse_count_memory"):
        yield effect or "nothing hidden", partial(emulated, effect, seed)
    for more in range(3):
        yield f"physics {more + 1}", partial(of_physics, seed + more)
    yield "as of an arm", partial(of_bouts, seed)

"""What contenders are given: a record whose rows of `validate` they predict in free run, and what the error counts in.

Muscles of the paper and of the emulator, whose equations are nobody's here; frog tetani and two benchmarks of nonlinear
identification, from local copies. One sample a pulse, so that all see the same rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bench.measured import benchmarks, frogs
from bench.muscles.bout_records import record_of_bouts
from bench.muscles.hidden_records import generate
from bench.muscles.physics_records import record_of_physics
from bench.strange import repeated
from stimrig.identify import paper
from stimrig.identify.records.record import HELD_OUT, Part, Record
from tests.harness.carried_sessions import as_record

RATE_HZ = 40.0
TOP_US = 300.0
FITTED = "fitted"
SHOWN = 50
"""Samples at the begin of what is to be predicted that show where a benchmark begins; their error is not counted."""
OWN_EFFECTS = Path(__file__).parent / "measured" / "own_effects"


@dataclass(frozen=True)
class Task:
    """One record.

    Parameters
    ----------
    name : str
        For people.
    record : Record
        Rows of `validate` may not be fitted, and are scored; it may have several parts, each with its own begin.
    unit : str
        What the error is told in.
    scale : float
        One of that unit, in the record's torque.
    true : bool
        Whether it is the paper's muscle, with its five parameters.
    own : tuple of dict
        Options of `fit` with an effect of `OWN_EFFECTS`, where there is one for it: the fitted rows choose among them.
    """

    name: str
    record: Record
    unit: str = "× noise"
    scale: float = 1.0
    true: bool = False
    own: tuple[dict[str, Any], ...] = ()

    @property
    def rate_hz(self) -> float:
        return round(self.record.sample_rate_hz, 3)

    @property
    def fitted(self) -> np.ndarray:
        """bool, shape (N,): rows that may be fitted."""
        return ~self.record.held_out

    @property
    def parts(self) -> list[slice]:
        """Rows of each part."""
        first = [part.first for part in self.record.parts]
        return [slice(a, b) for a, b in zip(first, [*first[1:], self.record.time_s.size], strict=True)]

    @property
    def stretches(self) -> list[slice]:
        """Rows of each part that may be fitted, in one piece."""
        change = np.flatnonzero(np.diff(np.r_[False, self.fitted, False].astype(int)))
        cuts = [part.start for part in self.parts[1:]]
        edges = [np.r_[a, [cut for cut in cuts if a < cut < b], b] for a, b in change.reshape(-1, 2)]
        return [slice(int(a), int(b)) for row in edges for a, b in pairwise(row)]

    @property
    def fine(self) -> bool:
        """Whether it has more than one sample a pulse."""
        return self.rate_hz > 1.5 * self.record.pulse_rate_hz

    def error(self, predicted: np.ndarray) -> float:
        """Root mean square on the unseen rows, in its unit."""
        return float(np.sqrt(np.mean((predicted - self.record.torque_nm)[~self.fitted] ** 2))) / self.scale


Maker = Callable[[], Task]


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
    made = generate(effect, "middle", seed, rate_hz=RATE_HZ)
    return Task(effect or "nothing hidden", as_record(made), scale=made["truth"]["noise"]["sd_nm"])


def rounded(made: dict[str, Any]) -> dict[str, Any]:
    """One sample a pulse of a generated record."""
    each = round((len(made["time_s"]) - 1) / float(made["time_s"][-1] - made["time_s"][0]) / RATE_HZ)
    rows = {name: made[name][::each] for name in ("time_s", "pulse_width_us", "torque_nm", "segment")}
    return made | rows | ({"bout": made["bout"][::each]} if "bout" in made else {})


def of_physics(seed: int) -> Task:
    """A muscle of other physics, with white noise alone."""
    made = rounded(record_of_physics("physics", seed, disturbed=()))
    return Task(f"physics: {made['truth']['kind']}", as_record(made), scale=made["truth"]["noise_sd_nm"])


def of_bouts(seed: int) -> Task:
    """A record as arms give them: its last ramp, in errors of the mean of the other ramps."""
    made = rounded(record_of_bouts(seed))
    rows, repetition = repeated(made)
    off = float(np.sqrt(np.mean((made["torque_nm"][rows] - repetition) ** 2)))
    return Task("as of an arm", as_record(made), unit="× repetition", scale=off)


def joined(name: str, runs: Sequence[benchmarks.Run], labels: Sequence[str], rate_hz: float, **others: Any) -> Task:
    """Runs of input, µs, and output, one part each; a label for each sample."""
    starts = np.cumsum([0, *(len(u) for u, _ in runs[:-1])])
    u, y = (np.concatenate([run[at] for run in runs]) for at in (0, 1))
    parts = [Part(int(start), 0.0) for start in starts]
    record = Record.from_arrays(np.arange(u.size) / rate_hz, u, y, [*labels], pulse_rate_hz=rate_hz, parts=parts)
    return Task(name, record, **others)


def last_unseen(runs: Sequence[benchmarks.Run], shown: int) -> list[str]:
    """Labels under which the last run is to be predicted, its first samples shown."""
    sizes = [len(u) for u, _ in runs]
    return [FITTED] * sum(sizes[:-1]) + ["begin"] * shown + [HELD_OUT] * (sizes[-1] - shown)


def tanks(data: Path | None) -> Task:
    """Cascaded tanks. A sample, 4 s, stands for a pulse interval, and the pump's voltage for a width.

    By Bernoulli's law the level at rest goes with the square of the inflow, as far as the pump gives what it is told.
    """
    runs = [(50.0 * u, y) for u, y in benchmarks.tanks(data)]
    curves = ({"recruitment": "power-series", "power": 2}, {"recruitment": "power-series", "power": 3}, {})
    own = tuple({"effects": ["overflowing_tanks"]} | curve for curve in curves)
    return joined("cascaded tanks", runs, last_unseen(runs, SHOWN), RATE_HZ, unit="V", own=own)


def drives(data: Path | None) -> Task:
    """Coupled drives: 300 samples of each run, then 200 that are to be predicted. Widths have no sign: 3 V more."""
    runs = [(50.0 * (u + 3.0), y) for u, y in benchmarks.drives(data)]
    return joined("coupled drives", runs, 2 * ([FITTED] * 300 + [HELD_OUT] * 200), RATE_HZ, unit="ticks/s")


def frog(data: Path | None, number: int) -> Task:
    """The last tetanus of an animal; error in % of its greatest force."""
    animal, trials = list(frogs.animals(data).items())[number]
    runs = [(TOP_US * pulse, force) for _, pulse, force in trials]
    peak = float(np.max(runs[-1][1]))
    labels = last_unseen(runs, frogs.BEFORE)
    return joined(f"frog {animal}", runs, labels, 1 / trials[-1][0], unit="% of peak", scale=peak / 100)


def makers(seed: int, data: Path | None, frogs_taken: int = 2) -> Iterator[tuple[str, Maker]]:
    """Name and maker of each task, in the order of the table."""
    yield "paper's muscle, 40 Hz", partial(papers, 40.0, 0.02, seed)
    yield "paper's muscle, 1600 Hz", partial(papers, 1600.0, 0.02, seed)
    seed = seed % 1000 + 1000
    for effect in (None, "fatigue", "series_compliance", "pulse_count_memory"):
        yield effect or "nothing hidden", partial(emulated, effect, seed)
    for more in range(3):
        yield f"physics {more + 1}", partial(of_physics, seed + more)
    yield "as of an arm", partial(of_bouts, seed)
    for number in range(frogs_taken):
        yield f"frog {number + 1}", partial(frog, data, number)
    yield "cascaded tanks", partial(tanks, data)
    yield "coupled drives", partial(drives, data)

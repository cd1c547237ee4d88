"""`python -m bench rivals [--only WORD,WORD]`: ours, peers, black boxes and the oracle, side by side.

Task by contender: error in free run on rows that nobody fitted, and seconds of the fit. Each sees the same record, on
the same machine, in the same run. A package that is not installed is reported.
`--only` takes words of tasks or contenders; `--write` puts the table into docs/results/bench.md.
"""

from __future__ import annotations

import platform
import time
import warnings
from collections.abc import Sequence

import numpy as np

from bench import black_boxes
from bench.black_boxes import BUDGET_S
from bench.common import RESULTS, bench_parser, table, written_by
from bench.contenders import CONTENDERS, Contender, Passes
from bench.tasks import Task, makers
from stimrig.identify.diagnosis import side_by_side
from stimrig.identify.errors import IdentifyError

SEED = 90_001
"""Nothing was developed on seeds from here on."""
TARGET = RESULTS / "bench.md"
RUNS_AWAY = 1e4
Row = list[str]


def score_contender(contender: Contender, task: Task, warm: bool) -> str:
    """Return error and seconds as text, or the reason why there are none."""
    if task.fine and not contender.fine:
        return "–"
    try:
        if warm:
            contender.fit(task)  # imports and compilation
        begin = time.perf_counter()
        predict = contender.fit(task)
        seconds = time.perf_counter() - begin
        error = task.error(np.nan_to_num(predict(), nan=1e30, posinf=1e30, neginf=-1e30))
    except Passes:
        return "–"
    except ImportError as missing:
        return f"not installed ({missing.name})"
    except (IdentifyError, ValueError, ArithmeticError, np.linalg.LinAlgError, IndexError) as failed:
        return f"failed ({type(failed).__name__}: {' '.join(str(failed).split())[:60]})"
    error_text = f"{error:.3g}" if error < RUNS_AWAY else "runs away"
    return f"{error_text}, {seconds:.2g} s"


def wanted(only: Sequence[str], name: str, names: Sequence[str]) -> bool:
    """Return true where a word of `only` is in `name`, or none of them is in any of `names`."""
    mine = [word for word in only if any(word in other for other in names)]
    return not mine or any(word in name for word in mine)


def measure(seed: int, only: Sequence[str]) -> tuple[list[Contender], list[Row]]:
    """A row for each task."""
    tasks = list(makers(seed))
    chosen = [c for c in CONTENDERS if wanted(only, c.name, [c.name for c in CONTENDERS])]
    rows: list[Row] = []
    for name, make in tasks:
        if not wanted(only, name, [name for name, _ in tasks]):
            continue
        task = make()
        rows.append([task.name, task.unit])
        for contender in chosen:
            rows[-1].append(score_contender(contender, task, warm=len(rows) == 1 and black_boxes.BUDGET_S > 0))
            print(f"{task.name}, {contender.name}: {rows[-1][-1]} ({task.unit})", flush=True)
    return chosen, rows


def document(seed: int, chosen: Sequence[Contender], rows: Sequence[Row]) -> str:
    """docs/results/bench.md: a column for each task, since there are fewer of them."""
    heads = ["", "what", *(f"{name}, {unit}" for name, unit, *_ in rows)]
    lines = [[c.name, c.what, *(row[2 + at] for row in rows)] for at, c in enumerate(chosen)]
    machine = f"Machine: {platform.processor() or platform.machine()}, Python {platform.python_version()}."
    return "\n".join(["# Identification beside its rivals", "", written_by("python -m bench rivals"), INTRO,
                      f"Seed {seed}. {machine}", "", *table(heads, lines), "", NOTES])  # fmt: skip


INTRO = """One run, one core, the same records. Root mean square in free run on rows that nobody fitted, and the seconds
of one fit. Of simulated muscles it counts in standard deviations of the white noise, which is in the measured torque: 1
is all that can be predicted. The paper's muscle: PRBS of 15.9 s and ramp of 10 s with rests, then a multi-level input.
The emulator's: a test of 47 s, with nothing or one thing hidden, or of a muscle of other physics. As of an arm: the
last of four equal ramps, in errors of the mean of the others."""
NOTES = """The peers take the recruitment as eight spline inputs and choose memory in samples; at 1600 samples a second
the same number of samples is a fortieth of the time. Ours works on the grid of pulses, at any sampling rate. The black
boxes have fixed settings and choose on fitted rows alone; who tunes them for one task will find better ones.
"""


def run(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the table."""
    parser = bench_parser(__doc__)
    parser.prog = "python -m bench rivals"
    parser.add_argument("--only", default="", help="words of tasks or contenders, separated by commas")
    parser.add_argument(
        "--budget", type=float, default=BUDGET_S, help="s in which a box looks for better starts; 0: one, cold"
    )
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--write", action="store_true", help=f"write docs/results/{TARGET.name}")
    options = parser.parse_args(arguments)
    warnings.filterwarnings("ignore")
    black_boxes.BUDGET_S, side_by_side.WORKERS = options.budget, 1
    text = document(options.seed, *measure(options.seed, [w for w in options.only.split(",") if w]))
    print(text)
    if options.write:
        TARGET.write_text(text)


if __name__ == "__main__":
    run()

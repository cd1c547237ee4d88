"""What is said of a structure that is carried over to the next session; see docs/diagnosis.md.

    python -m bench.carried --seeds 5101:5131 [--workers 2] [--json FILE]

Each seed is one muscle. In the first session it has two hidden effects, and the model with both, each in the form that
fits best, is the one that was approved. Second sessions are other tests of the same muscle (other pulses and noise,
another zero, sign and scale of the load cell) with `both` effects, with `one` of them, with `none`, and with both and a
`third`. Seeds 5001 to 5020 were developed on. The records come from the emulator's physics, whose equations are not the
library's.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from typing import Any

from bench.common import in_processes, keep, parser, table
from stimrig import identify
from stimrig.hardware_sim.hidden.scenario import Scenario
from stimrig.identify.conclusion import caution
from stimrig.identify.diagnosis import side_by_side
from tests.harness.carried_sessions import SESSIONS, muscle, session


def one(seed: int) -> list[dict[str, Any]]:
    """What is said of each second session of one muscle."""
    side_by_side.WORKERS = 1
    of = muscle(seed)
    names = [hidden.effect for hidden in of.hidden]
    try:
        approved = identify.fit(session(of, seed, "first", (0, 1)), effects=names[:2])
    except identify.NotIdentifiable as error:
        return [{"seed": seed, "effects": names, "session": "first", "problem": str(error)}]
    return [second(of, seed, label, approved) for label in SESSIONS]


def second(of: Scenario, seed: int, label: str, approved: identify.Model) -> dict[str, Any]:
    """What is said of one second session."""
    record, began_s = session(of, seed, label, SESSIONS[label]), time.perf_counter()
    found = identify.carry(record, approved)
    seconds = time.perf_counter() - began_s
    new = identify.diagnose(record, found.model) if label == "third" else None
    return {
        "seed": seed,
        "session": label,
        "effects": [hidden.effect for hidden in of.hidden],
        "there": [of.hidden[index].effect for index in SESSIONS[label]],
        "still_needed": found.still_needed,
        "undecided": found.undecided,
        "gains": {row["effect"]: row["log_evidence_gain"] for row in found.effects},
        "offered": found.offered,
        "reason": found.reason,
        "new": None if new is None else [entry["effect"] for entry in new.missing],
        "new_is_open": new is not None and (new.verdict != "nothing_missing" or bool(caution(vars(new)))),
        "seconds": seconds,
    }


def counts(rows: list[dict[str, Any]]) -> list[list[object]]:
    """The counts as rows of a table."""
    total: Counter[str] = Counter()
    right: Counter[str] = Counter()
    open_: Counter[str] = Counter()
    for row in (row for row in rows if "problem" not in row):
        label, there = row["session"], row["there"]
        for effect in row["effects"][:2]:
            line = f"{'still' if effect in there else 'no longer'} needed, second session with {label}"
            total[line] += 1
            said = "undecided" if effect in row["undecided"] else effect in row["still_needed"]
            right[line] += said == (effect in there)
            open_[line] += said == "undecided"
        line = f"offered as it should be, second session with {label}"
        total[line] += 1
        right[line] += row["offered"] == ("carried" if there else "plain")
        if row["new"] is not None:
            total["the new effect is named"] += 1
            right["the new effect is named"] += row["effects"][2] in row["new"]
            open_["the new effect is named"] += not row["new"] and row["new_is_open"]
    return [[line, f"{right[line]} of {total[line]}", open_[line] or ""] for line in total]


def main() -> None:
    """Print the counts."""
    made = parser(__doc__, "5101:5131")
    made.add_argument("--workers", type=int, default=2)
    options = made.parse_args()
    rows: list[dict[str, Any]] = []
    for found in in_processes(one, options.seeds, options.workers):
        rows += found
        print(*map(json.dumps, found), sep="\n", file=sys.stderr, flush=True)
    print(*table(["second sessions of muscles seen before", "right", "undecided"], counts(rows)), sep="\n")
    slow = sorted(row["seconds"] for row in rows if "seconds" in row)
    print(f"\ncarrying over took {slow[len(slow) // 2]:.1f} s in the middle, {slow[-1]:.1f} s at most")
    keep(options.json, rows)


if __name__ == "__main__":
    main()

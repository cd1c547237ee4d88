"""How often a change is claimed of a muscle that has not changed, and how often a true one is found.

    python -m bench.trend --seeds 6101:6141 [--write]

Each emulated muscle is tested twice from rest, an hour apart: other pulses, other noise, the same muscle. Both records
are identified and compared as the pages compare two sessions. The floors of `api.models.changes` were chosen on seeds
6001 to 6020; report on 6101 to 6140. `--write` renews docs/results/trend.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.common import RESULTS, parser, seed_range, table, written_by
from stimrig import identify
from stimrig.api.models import changes, stored_model
from stimrig.api.models.changes import State
from stimrig.hardware_sim.hidden.library import STILL
from stimrig.hardware_sim.hidden_records import generate
from stimrig.identify.errors import IdentifyError
from tests.harness.carried_sessions import as_record

APART_S = 3600.0
DRIFTING = ("baseline_drift", "threshold_drift")
"""Muscles and sensors that are another an hour later: there, something has changed."""
SETS = {
    "nothing hidden": "white noise",
    "slow noise": "nothing hidden, slow noise of the same size beside the white",
    "effect unseen": "a hidden effect of middle strength, both models of the plain structure",
    "effect held": "the same, both models hold the effect",
    "other structure": "the same, the first model plain, the second one with the effect",
}
LOWER = (0.98, 0.95, 0.8)
"""Shares to which the plateau of the second record is lowered, to see whether that is found."""


@dataclass(frozen=True)
class Pair:
    """Two models of one muscle."""

    kind: str
    seed: int
    before: State
    now: State

    def claims(self) -> list[dict[str, Any]]:
        """What would be told."""
        return changes.changed(self.before, self.now)


def records(effect: str | None, seed: int, noise: str) -> list[identify.Record]:
    """Two tests of one muscle."""
    made = generate(effect, "middle", seed, noise=noise, again_after_s=APART_S)
    cut = int(np.argmax(np.diff(made["time_s"]))) + 1
    parts = []
    for rows in (slice(0, cut), slice(cut, None)):
        part = {name: values[rows] for name, values in made.items() if isinstance(values, np.ndarray)}
        parts.append(as_record(part | {"time_s": part["time_s"] - part["time_s"][0]}))
    return parts


def state(record: identify.Record, effects: tuple[str, ...] = ()) -> State:
    """A record's model as the pages compare it."""
    document = identify.fit(record, effects=effects).to_dict()
    figures = stored_model.muscle_figures(document)
    return State(figures, document["method"], changes.structure_of(list(effects), figures))


def pairs(seed: int) -> Iterator[Pair]:
    """The sets of one seed."""
    for kind, noise in (("nothing hidden", "white"), ("slow noise", "slow")):
        yield Pair(kind, seed, *(state(record) for record in records(None, seed, noise)))
    names = [name for name in STILL if name not in DRIFTING]
    effect = names[seed % len(names)]
    both = records(effect, seed, "white")
    plain = [state(record) for record in both]
    yield Pair("effect unseen", seed, *plain)
    held = [state(record, (effect,)) for record in both]
    yield Pair("effect held", seed, *held)
    yield Pair("other structure", seed, plain[0], held[1])


def lowered(pair: Pair, share: float) -> Pair:
    """The pair as if the second record's torque were so much lower."""
    plateau = pair.now.figures["plateau_nm"]
    less = {**plateau, "value": share * plateau["value"], "sd": share * plateau["sd"]}
    return replace(pair, now=replace(pair.now, figures={**pair.now.figures, "plateau_nm": less}))


def bare(pair: Pair) -> int:
    """How many figures would be claimed by the two standard deviations alone."""
    count = 0
    for name in changes.comparable(pair.before, pair.now):
        old, new = pair.before.figures[name], pair.now.figures[name]
        if None in (old["value"], new["value"], old["sd"], new["sd"]):
            continue
        count += abs(new["value"] - old["value"]) > changes.BEYOND * np.hypot(old["sd"], new["sd"])
    return count


def rates(found: list[Pair]) -> list[str]:
    """The rates as Markdown."""
    heads = "two tests of a muscle that has not changed; pairs; any change claimed; figures claimed; of"
    heads += "; without the floors; plateau 2 % lower found; 5 %; 20 %"
    lines = []
    for kind, words in SETS.items():
        here = [pair for pair in found if pair.kind == kind]
        claims = [pair.claims() for pair in here]
        compared = sum(len(changes.comparable(pair.before, pair.now)) for pair in here)
        seen = [
            sum(any(one["figure"] == "plateau_nm" for one in lowered(pair, share).claims()) for pair in here)
            for share in LOWER
        ]
        counts = [len(here), sum(bool(one) for one in claims), sum(map(len, claims)), compared, sum(map(bare, here))]
        lines.append([f"{kind}: {words}", *counts, *seen])
    return table(heads.split("; "), lines)


def told(found: list[Pair]) -> list[str]:
    """Which figures were claimed without reason, by set."""
    counts = Counter((pair.kind, one["figure"]) for pair in found for one in pair.claims())
    return [f"{kind}: {figure} {count}" for (kind, figure), count in sorted(counts.items())]


def run(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seeds", type=seed_range, default="6101:6141")
    made.add_argument("--write", action="store_true")
    options = made.parse_args(arguments)
    found: list[Pair] = []
    for seed in options.seeds:
        try:
            found += pairs(seed)
        except IdentifyError as error:
            print(f"{seed}: {error}", flush=True)
    for pair in found:
        for one in pair.claims():
            moved = f"{one['before']:.5g} to {one['now']:.5g} {one['unit']}, {one['times']:.1f} times"
            print(
                f"{pair.kind}, seed {pair.seed}, {pair.before.structure or pair.now.structure}: {one['figure']} {moved}"
            )
    lines = [*rates(found), "", f"Claimed without reason: {'; '.join(told(found)) or 'nothing'}."]
    print("\n".join(lines))
    if options.write:
        file = RESULTS / "trend.md"
        text = file.read_text(encoding="utf-8").split("<!-- measured -->")[0] if file.exists() else ""
        seeds = f"{options.seeds.start}:{options.seeds.stop}"
        stamp = written_by(f"python -m bench.trend --seeds {seeds} --write")
        file.write_text(text + "\n".join(["<!-- measured -->", stamp, "", *lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    run()

"""How many stimuli it takes to find an electrode of an array: ours, and what is usually done, on emulated people.

    python -m bench.electrodes [--seeds 1000:1200] [--json FILE]

Even seeds have 16 elements and all 136 choices, odd ones 24 and the pairs that are near; the four wishes take turns.
The current is raised in steps of 2 mA at the middle element of another day until comfort is 6. Ours stops by itself;
the yardsticks stop where their rule ends, and take what looked best. "Found" is the first stimulus after which the best
so far is within 10 % of the best; "wrong" is more than 20 % below it. Utility is that of the true torque and comfort;
a true spill-over is slight from a share of 0.08 and strong from 0.35 ("by kind"), or priced by how often it is seen so
("as seen"), which has no edge where two choices that are alike differ in everything.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.stats import norm

from bench.common import in_processes, keep, parser, table, written_by
from stimrig.hardware_sim.electrode_array import draw_array
from stimrig.identify.electrodes import PRESETS, Elements, Layout, Search, Seen, choices

WIDTH_US, STEP_MA, LARGEST_MA, FELT = 300.0, 2.0, 40.0, 6
SHARES, SHARE_SD = (0.08, 0.35), 0.04
"""Of the neighbour, from which a spill-over is slight and strong; the error with which it is seen."""
NEAR_PITCHES = 2.3
SPACE = 0.2
"""Part of the choices that a field search stimulates."""
HEADS = ("method", "people", "stimuli, median", "p95", "found, median", "found, p95", "within 10 %", "wrong",
         "within 10 %, as seen", "wrong, as seen")  # fmt: skip


class Person:
    """One emulated person with an array, on one day."""

    def __init__(self, seed: int, session: int) -> None:
        self.array = draw_array(seed, 24 if seed % 2 else 16)
        self.layout = Layout(tuple((float(x), float(y)) for x, y in np.asarray(self.array.grid_mm)))
        self.farthest_mm = NEAR_PITCHES * self.array.pitch_mm if seed % 2 else None
        self.choices = choices(self.layout, self.farthest_mm)
        self.name = list(PRESETS)[seed // 2 % len(PRESETS)]
        self.wish = PRESETS[self.name][1]
        self.random = np.random.default_rng(seed)
        self.middle = int(np.argmin(np.hypot(*(self.layout.centred_mm + 1e-3).T))) + 1
        self.current_ma = self._bearable_ma()
        self.session = self.array.session(session)

    def _bearable_ma(self) -> float:
        other_day, current_ma = self.array.session(0), 2 * STEP_MA
        while current_ma < LARGEST_MA and other_day.stimulate((self.middle,), WIDTH_US, current_ma).comfort > FELT:
            current_ma += STEP_MA
        return current_ma

    def stimulate(self, elements: Elements) -> Seen:
        seen = self.session.stimulate(elements, WIDTH_US, self.current_ma)
        return Seen(float(seen.torque_nm), int(seen.spill), float(seen.comfort))

    def looks(self, seen: Seen) -> float:
        """Utility as it is reported."""
        return float(self.wish.utility(*map(np.asarray, (seen.torque_nm, seen.spill, seen.comfort))))

    def true(self) -> dict[str, dict[Elements, float]]:
        """Utility of each choice as the array lies now."""
        field = self.session.field(WIDTH_US, self.current_ma)
        rows = [list(self.array.choices).index(each) for each in self.choices]
        torque_nm, share, comfort = field.torque_nm[rows], field.spill[rows], 10.0 - field.pain[rows]
        sure = self.wish.utility(torque_nm, np.digitize(share, SHARES), comfort)
        above = [np.ones_like(share), *(norm.cdf((share - each) / SHARE_SD) for each in SHARES), np.zeros_like(share)]
        kinds = [self.wish.utility(torque_nm, np.full(len(share), kind), comfort) for kind in range(3)]
        seen = np.sum([(above[kind] - above[kind + 1]) * each for kind, each in enumerate(kinds)], axis=0)
        return {"kind": dict(zip(self.choices, sure, strict=True)), "seen": dict(zip(self.choices, seen, strict=True))}


Steps = Iterator[Elements | None]
"""The best so far after each stimulus."""


def ours(person: Person, search: Search, times_s: list[float]) -> Steps:
    while search.enough() is None:
        began_s = time.perf_counter()
        chosen = search.next().elements
        times_s.append(time.perf_counter() - began_s)
        search.add(chosen, person.stimulate(chosen))
        times_s[-1] -= time.perf_counter()
        yield search.best()
        times_s[-1] += time.perf_counter()


def all_of(person: Person, some: list[Elements]) -> Steps:
    """Stimulate these, and take what looks best."""
    looks: dict[Elements, float] = {}
    for chosen in some:
        looks[chosen] = person.looks(person.stimulate(chosen))
        best = max(looks, key=lambda each: looks[each])
        yield best if looks[best] > 0.0 else None


def spread_out(person: Person) -> Steps:
    """A fifth of the space, each as far from those before as can be."""
    where = np.array([person.layout.centred_mm[np.array(each) - 1].mean(axis=0) for each in person.choices])
    picked = [person.choices.index((person.middle,))]
    while len(picked) < SPACE * len(where):
        far = np.min(np.linalg.norm(where[:, None] - where[None, picked], axis=2), axis=1)
        far[picked] = -1.0
        picked.append(int(np.argmax(far + 0.1 * person.random.random(len(far)))))
    return all_of(person, [person.choices[at] for at in picked])


def at_random(person: Person) -> Steps:
    order = person.random.permutation(len(person.choices))[: int(np.ceil(SPACE * len(person.choices)))]
    return all_of(person, [person.choices[at] for at in order])


def singles(person: Person) -> Steps:
    return all_of(person, [each for each in person.choices if len(each) == 1])


def coordinates(person: Person) -> Steps:
    """From the middle element to its neighbours while one looks better, then pairs with the best."""
    where, looks = person.layout.centred_mm, dict[Elements, float]()

    def around(at: int) -> list[int]:
        far = np.linalg.norm(where - where[at - 1], axis=1)
        return [int(each) + 1 for each in np.flatnonzero((far > 0.0) & (far < 1.1 * person.array.pitch_mm))]

    def tried(chosen: Elements) -> Elements | None:
        looks[chosen] = person.looks(person.stimulate(chosen))
        best = max(looks, key=lambda each: looks[each])
        return best if looks[best] > 0.0 else None

    at, moved = person.middle, True
    yield tried((at,))
    while moved:
        for each in around(at):
            if (each,) not in looks:
                yield tried((each,))
        best = max((each for each in looks if len(each) == 1), key=lambda each: looks[each])[0]
        moved, at = looks[best,] > looks[at,], best
    for each in around(at):
        yield tried((min(at, each), max(at, each)))


YARDSTICKS: dict[str, Callable[[Person], Steps]] = {
    "a field search of a fifth of the space": spread_out,
    "all single elements": singles,
    "from neighbour to neighbour": coordinates,
    "a fifth of the space at random": at_random,
}


def judged(person: Person, steps: Steps) -> dict[str, Any]:
    """What became of one search."""
    best, true = [*steps], person.true()
    row: dict[str, Any] = {"stimuli": len(best), "use": max(true["kind"].values()) > 0.0}
    for name, utility in true.items():
        top = max(utility.values())
        shares = [utility[each] / top if each and top > 0.0 else float(top <= 0.0 and each is None) for each in best]
        row[name] = {
            "found": next((count for count, share in enumerate(shares, 1) if share >= 0.9), None),
            "share": float(shares[-1]) if shares else 0.0,
        }
    return row


def one(seed: int) -> dict[str, Any]:
    """All methods with one person."""
    person, times_s = Person(seed, 1), list[float]()
    settings = (person.layout, person.wish, WIDTH_US, person.current_ma)
    first = Search(*settings, farthest_mm=person.farthest_mm)
    rows = {"ours": judged(person, ours(person, first, times_s))}
    again = Person(seed, 2)
    known = Search(*settings, first, farthest_mm=person.farthest_mm)
    rows["ours, a person of one session before"] = judged(again, ours(again, known, times_s))
    rows |= {name: judged(each, method(each)) for name, method in YARDSTICKS.items() for each in [Person(seed, 1)]}
    return {"seed": seed, "wish": person.name, "elements": 24 if seed % 2 else 16, "current_ma": person.current_ma,
            "choices": len(person.choices), "slowest_s": max(times_s), "methods": rows}  # fmt: skip


def cells(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    stimuli = [row["stimuli"] for row in rows]
    found = [row["kind"]["found"] or np.inf for row in rows]
    ranks = [np.percentile(found, rank, method="higher") for rank in (50, 95)]
    parts = [f"{np.median(stimuli):.0f}", f"{np.percentile(stimuli, 95):.0f}",
             *("never" if np.isinf(each) else f"{each:.0f}" for each in ranks)]  # fmt: skip
    for utility in ("kind", "seen"):
        share = np.array([row[utility]["share"] for row in rows])
        parts += [f"{np.mean(share >= 0.9):.0%}", f"{np.mean(share < 0.8):.1%}"]
    return [name, str(len(rows)), *parts]


def report(people: list[dict[str, Any]]) -> list[str]:
    """The table, then ours by number of elements and by wish."""
    of_use = [each for each in people if each["methods"]["ours"]["use"]]
    lines = table(HEADS, (cells(name, [each["methods"][name] for each in of_use]) for name in people[0]["methods"]))
    groups = [(f"{count} elements", "elements", count) for count in (16, 24)] + [(n, "wish", n) for n in PRESETS]
    parts = [(said, [each for each in of_use if each[key] == value]) for said, key, value in groups]
    lines += ["", *table(("ours with", *HEADS[1:]), (cells(said, [each["methods"]["ours"] for each in some])
                                                       for said, some in parts if some))]  # fmt: skip
    none = [each["methods"]["ours"] for each in people if not each["methods"]["ours"]["use"]]
    right = sum(row["kind"]["share"] == 1.0 for row in none)
    slow = max(each["slowest_s"] for each in people)
    return [*lines, "", f"No choice is of use to {len(none)} people; ours ends so with {right} of them.",
            f"Slowest stimulus of ours: {slow:.2f} s to compute."]  # fmt: skip


def main() -> None:
    made = parser(__doc__, "1000:1200")
    made.add_argument("--workers", type=int, default=2)
    given = made.parse_args()
    people = list(in_processes(one, given.seeds, given.workers))
    keep(given.json, people)
    print("\n".join([written_by("python -m bench.electrodes"), "", *report(people)]))


if __name__ == "__main__":
    main()

"""The search over an electrode array: what it finds, what must not matter to it, and what it refuses."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from stimrig.identify.electrodes import PRESETS, Elements, Layout, Search, Seen, Wish, choices
from stimrig.identify.errors import BadRequest

GRID = tuple((15.0 * column, 15.0 * row) for row in range(4) for column in range(4))
BALANCED = PRESETS["balanced"][1]


@dataclass(frozen=True)
class Person:
    """A muscle under one place and a neighbour under another; torque falls linearly, so that no curve is as assumed."""

    layout: Layout
    muscle_mm: tuple[float, float] = (12.0, 33.0)
    neighbour_mm: tuple[float, float] = (40.0, 5.0)
    largest_nm: float = 6.0
    comfort: float = 7.0

    def _near(self, elements: Sequence[int], centre: tuple[float, float]) -> float:
        where = np.array([self.layout.positions_mm[each - 1] for each in elements])
        return float(np.mean(np.maximum(0.0, 1.0 - np.hypot(*(where - centre).T) / 40.0)))

    def seen(self, elements: Sequence[int]) -> Seen:
        spilled = self._near(elements, self.neighbour_mm)
        torque_nm = self.largest_nm * self._near(elements, self.muscle_mm)
        return Seen(torque_nm, int(spilled > 0.2) + int(spilled > 0.5), self.comfort)

    def utility(self, elements: Sequence[int], wish: Wish = BALANCED) -> float:
        seen = self.seen(elements)
        return float(wish.utility(*(np.array(each) for each in (seen.torque_nm, seen.spill, seen.comfort))))


def new(layout: Layout, wish: Wish = BALANCED, prior: Search | None = None) -> Search:
    return Search(layout, wish, 300.0, 12.0, prior)


def play(search: Search, person: Person) -> int:
    """Search until it is enough; the number of stimuli."""
    while search.enough() is None and len(search.seen) < 30:
        chosen = search.next().elements
        search.add(chosen, person.seen(chosen))
    return len(search.seen)


@pytest.fixture(scope="module")
def finished() -> tuple[Search, Person]:
    layout = Layout(GRID)
    search, person = new(layout), Person(layout)
    play(search, person)
    return search, person


def test_choices_are_single_elements_and_near_pairs() -> None:
    layout = Layout(GRID)
    assert len(choices(layout)) == 16 + 120
    near = choices(layout, 15.0)
    assert len(near) == 16 + 24
    assert (1, 2) in near
    assert (1, 6) not in near


def test_it_finds_a_choice_within_a_tenth_of_the_best(finished: tuple[Search, Person]) -> None:
    search, person = finished
    stop, best = search.enough(), search.best()
    assert stop is not None and best is not None
    assert stop.elements == best
    assert 0.0 < stop.probability <= 1.0
    assert person.utility(best) >= 0.9 * max(map(person.utility, search.choices))
    assert len(search.seen) <= 15


def test_the_map_says_what_was_seen(finished: tuple[Search, Person]) -> None:
    search, person = finished
    rows = {tuple(row["elements"]): row for row in search.map()}
    assert list(rows) == search.choices
    tried = {elements for elements, _ in search.seen}
    assert {elements for elements, row in rows.items() if row["stimulated"]} == tried
    for elements in tried:
        torque = rows[elements]["torque_nm"]
        assert abs(torque["mean"] - person.seen(elements).torque_nm) < 0.1 * person.largest_nm
    sd = {known: np.mean([row["torque_nm"]["sd"] for each, row in rows.items() if (each in tried) == known])
          for known in (True, False)}  # fmt: skip
    assert sd[True] < sd[False]


def test_a_kept_search_goes_on_as_it_would_have(finished: tuple[Search, Person]) -> None:
    search, _ = finished
    again = Search.from_dict(json.loads(json.dumps(search.to_dict())))
    assert again.next() == search.next()
    assert again.map() == search.map()
    assert again.to_dict() == search.to_dict()
    known = new(search.layout, prior=search)
    assert Search.from_dict(json.loads(json.dumps(known.to_dict()))).next() == known.next()


def utilities(search: Search) -> dict[Elements, float]:
    return {tuple(row["elements"]): row["utility"]["mean"] for row in search.map()}


def told(layout: Layout, person: Person, tried: Sequence[Elements]) -> dict[Elements, float]:
    search = new(layout)
    for elements in tried:
        search.add(elements, person.seen(elements))
    return utilities(search)


TRIED: list[Elements] = [(6,), (11,), (9, 14), (4,)]


@pytest.mark.parametrize("turn", [0.0, 0.7, math.pi / 2])
def test_where_the_array_lies_and_how_it_is_turned_does_not_matter(turn: float) -> None:
    """Up to the chance of the draws: they are not turned with it."""
    person = Person(Layout(GRID))
    turned = np.array(GRID) @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + [120.0, -40.0]
    here = told(person.layout, person, TRIED)
    there = told(Layout(tuple(map(tuple, turned.tolist()))), person, TRIED)
    assert_alike(here, there, exactly=turn == 0.0)


def assert_alike(here: dict[Elements, float], there: dict[Elements, float], *, exactly: bool) -> None:
    one, other = (np.array([found[each] for each in here]) for found in (here, there))
    assert np.sqrt(np.mean((one - other) ** 2)) < (1e-6 if exactly else 0.12) * one.max()


def test_how_elements_are_numbered_does_not_matter() -> None:
    person = Person(Layout(GRID))
    number = {old + 1: new + 1 for new, old in enumerate(np.random.default_rng(0).permutation(16).tolist())}
    renumbered = Layout(tuple(GRID[old - 1] for old in sorted(number, key=lambda old: number[old])))

    def name(elements: Sequence[int]) -> Elements:
        return tuple(sorted(number[each] for each in elements))

    here = told(person.layout, person, TRIED)
    there = told(renumbered, replace(person, layout=renumbered), [name(each) for each in TRIED])
    assert_alike(here, {each: there[name(each)] for each in here}, exactly=False)


def test_the_unit_of_torque_does_not_matter() -> None:
    layout = Layout(GRID)
    small, large = new(layout), new(layout, replace(BALANCED, least_nm=1000 * BALANCED.least_nm))
    for _ in range(4):
        chosen = small.next().elements
        assert large.next().elements == chosen
        seen = Person(layout).seen(chosen)
        small.add(chosen, seen)
        large.add(chosen, replace(seen, torque_nm=1000 * seen.torque_nm))
    assert 1000 * small.next().expected == pytest.approx(large.next().expected)


def test_the_order_of_what_was_seen_does_not_matter() -> None:
    person = Person(Layout(GRID))
    assert_alike(told(person.layout, person, TRIED), told(person.layout, person, TRIED[::-1]), exactly=False)


def test_a_known_person_needs_fewer_stimuli() -> None:
    """The array lies 5 mm beside where it lay."""
    first = second = 0
    for at in ((12.0, 33.0), (5.0, 10.0)):
        person = Person(Layout(GRID), muscle_mm=at)
        search = new(person.layout)
        first += play(search, person)
        moved = replace(person, muscle_mm=(at[0] + 4.0, at[1] - 3.0), neighbour_mm=(44.0, 2.0))
        known = new(person.layout, prior=search)
        second += play(known, moved)
        best = known.best()
        assert best is not None
        assert moved.utility(best) >= 0.8 * max(map(moved.utility, known.choices))
    assert second < 0.7 * first


def test_a_strong_spill_over_is_never_the_best() -> None:
    """The neighbour lies above the muscle: what moves the joint most spills over most."""
    person = Person(Layout(GRID), neighbour_mm=(12.0, 33.0))
    search = new(person.layout)
    for chosen in ((9,), (10,), (13,), (1,), (14,)):
        search.add(chosen, person.seen(chosen))
    best = search.best()
    assert best is not None
    assert person.seen(best).spill < 2
    assert [each for each, seen in search.seen if seen.spill == 2]
    assert search.map()[8]["utility"]["mean"] < 0.3 * search.map()[0]["utility"]["mean"]


@pytest.mark.parametrize("noise_nm", [0.0, 0.01])
def test_where_nothing_reacts_no_element_wins(noise_nm: float) -> None:
    layout, random = Layout(GRID), np.random.default_rng(1)
    search = new(layout)
    while (stop := search.enough()) is None and len(search.seen) < 30:
        search.add(search.next().elements, Seen(noise_nm * float(random.standard_normal()), 0, 8.0))
    assert stop is not None
    assert stop.elements is None
    assert search.best() is None
    assert "no element moves the joint" in stop.reason.lower()
    assert len(search.seen) >= 4, "one that does not react says little of the rest"


def test_where_all_hurts_it_does_not_say_that_nothing_moves() -> None:
    person = Person(Layout(GRID), comfort=1.0)
    search = new(person.layout)
    play(search, person)
    stop = search.enough()
    assert stop is not None
    assert stop.elements is None
    assert "moves the joint" not in stop.reason


@pytest.mark.parametrize(
    ("elements", "seen"),
    [
        ((17,), (1.0, 0, 5.0)),
        ((0,), (1.0, 0, 5.0)),
        ((1, 1), (1.0, 0, 5.0)),
        ((1, 2, 3), (1.0, 0, 5.0)),
        ((), (1.0, 0, 5.0)),
        ((1,), (math.nan, 0, 5.0)),
        ((1,), (math.inf, 0, 5.0)),
        ((1,), (1.0, 3, 5.0)),
        ((1,), (1.0, 0, 11.0)),
        ((1,), (1.0, 0, math.nan)),
    ],
)
def test_what_cannot_be_is_refused(elements: Elements, seen: tuple[float, int, float]) -> None:
    search = new(Layout(GRID))
    with pytest.raises(BadRequest) as refused:
        search.add(elements, Seen(*seen))
    assert refused.value.place
    assert search.seen == []


def test_layouts_and_kept_searches_that_cannot_be_are_refused() -> None:
    for where in (((0.0, 0.0),), ((0.0, 0.0), (math.nan, 1.0)), ((0.0, 0.0), (0.0, 0.0))):
        with pytest.raises(BadRequest):
            Layout(where)
    kept = new(Layout(GRID)).to_dict()
    for name in kept:
        if name != "schema_version":
            with pytest.raises(BadRequest):
                Search.from_dict({each: value for each, value in kept.items() if each != name})
    with pytest.raises(BadRequest, match="too far"):
        Search(Layout(GRID), BALANCED, 300.0, 12.0, farthest_mm=15.0).add((1, 16), Seen(1.0, 0, 5.0))


def test_utility_falls_with_spill_over_and_discomfort_and_is_none_where_it_is_out() -> None:
    for _, wish in PRESETS.values():
        spill = wish.utility(np.full(3, 5.0), np.arange(3), np.full(3, 8.0))
        assert all(one > other for one, other in pairwise(spill))
        assert spill[2] == 0.0
        comfort = wish.utility(np.full(3, 5.0), np.zeros(3, int), np.array([9.0, 6.0, 1.0]))
        assert comfort[0] >= comfort[1] > comfort[2] == 0.0
    capped = replace(BALANCED, wanted_nm=2.0).utility(np.array([2.0, 9.0]), np.zeros(2, int), np.full(2, 10.0))
    assert capped.tolist() == [2.0, 2.0]

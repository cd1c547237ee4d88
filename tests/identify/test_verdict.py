"""The verdict's own arithmetic, on analyses made by hand: every rule at both sides of its threshold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stimrig.identify.diagnosis import search, verdict
from stimrig.identify.diagnosis.residual import HeldOutError, ResidualStructure
from stimrig.identify.diagnosis.search import EffectSearch, Step
from stimrig.identify.diagnosis.verdict import Verdict, judge, shares
from stimrig.identify.effects import find_effect
from stimrig.identify.noise import NoiseLevel
from stimrig.identify.records.readings import Readings

FIRST, SECOND, EFFORT, TREMOR = "fatigue", "output_saturation", "voluntary_effort", "tremor"


def candidate(effect: str, gain: float) -> Any:
    return SimpleNamespace(effect=find_effect(effect), gain=gain, refusal=None)


def fitted(log_likelihood: float, *effects: str, wave_s: float = 1.0, **parameters: float) -> Any:
    """A fit as the verdict sees it: 100 s of fitted rows at 40 intervals a second; the base has -20."""

    def parameters_of(effect: str) -> dict[str, float]:
        assert effect in effects
        return parameters

    forms = tuple(
        (effect, SimpleNamespace(stage=find_effect(effect).forms[0].stage, name="bumps")) for effect in effects
    )
    return SimpleNamespace(
        log_likelihood=log_likelihood - 20.0,
        heavy_tails=False,
        effects=forms,
        noise=NoiseLevel(0.5, 0.5, 1.0, decay=1.0 - 0.025 / wave_s),
        parameters_of=parameters_of,
        problem=SimpleNamespace(setup=SimpleNamespace(fitted=np.ones(4000, bool), grid=SimpleNamespace(step_s=0.025))),
    )


class Made:
    """A search in which nothing is missing, to be changed; what the record says stands beside it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.at_rest = 1.0
        self.rises: set[int] = set()
        self.unseen: list[HeldOutError | None] = [None, None]
        self.asked = 0
        base = fitted(0.0)
        self.raw = SimpleNamespace(readings=None)
        self.left_by_first = self.left_by_last = self.left()
        self.search = EffectSearch(
            raw=self.raw, rows=np.ones(4000, bool), begun_with=(), plain=base, steps=[Step(None, base, "base")],
            quiet=np.zeros(4000, bool), refused=(candidate(FIRST, 1.0),),
        )  # fmt: skip
        monkeypatch.setattr(search, "share_at_rest", self._share_at_rest)
        for module in (search, verdict):
            monkeypatch.setattr(module, "residual_structure", self._residual)
        monkeypatch.setattr(verdict, "vetoed", self._rise)
        monkeypatch.setattr(verdict, "held_out_error", self._unseen)

    def left(
        self,
        ratio: float = 0.0,
        ideal: float = 80.0,
        busy_nm: float = 1.0,
        white_nm: float = 0.0,
        scale_nm: float = 9.0,
    ) -> ResidualStructure:
        return ResidualStructure(white_nm, busy_nm, ratio, ideal, scale_nm=scale_nm)

    def add(self, effect: str, gain: float, log_likelihood: float, rival: float = 0.0, **parameters: float) -> Made:
        """One effect more, that took the log-likelihood so far."""
        names = [str(step.added) for step in self.search.steps[1:]]
        tried = (candidate(effect, gain), candidate("potentiation", rival))
        model = fitted(log_likelihood, *names, effect, **parameters)
        self.search.steps.append(Step(effect, model, "library", tried))
        self.search.refused = ()
        return self

    def detect(self, effect: str, log_likelihood: float = 0.0) -> None:
        self.search.steps.append(Step(effect, fitted(log_likelihood, effect), "detected"))

    def leaves(self, **left: float) -> Made:
        self.left_by_last = self.left(**left)
        return self

    @property
    def last(self) -> Any:
        return self.search.last

    def judged(self) -> Verdict:
        return judge(self.search)

    def held(self, held_s: float) -> Made:
        """A recorder that holds each reading so long, at 400 samples a second."""
        self.raw.readings = Readings("held", np.arange(9), 400.0 * held_s, held_s=held_s)
        return self

    def _residual(self, fit: Any, quiet: Any) -> ResidualStructure:
        assert quiet is self.search.quiet
        return self.left_by_last if fit is self.last else self.left_by_first

    def _share_at_rest(self, quiet: Any, holder: Any, effect: str) -> float:
        assert quiet is self.search.quiet
        assert holder is next(step.searched for step in self.search.steps if step.added == effect)
        return self.at_rest

    def _rise(self, before: Any, after: Any) -> str | None:
        number = [step.searched for step in self.search.steps].index(before)
        assert after is self.search.steps[number + 1].searched
        return "the error would rise" if number in self.rises else None

    def _unseen(self, _fit: Any, beside: Any) -> HeldOutError | None:
        assert beside is self.last
        self.asked += 1
        return self.unseen[(self.asked + 1) % 2]  # that of the first model is asked for first


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    return Made(monkeypatch)


def test_nothing_missing(made: Made):
    found = made.judged()
    assert (found.kind, found.probabilities, found.rivals, found.notes) == ("nothing_missing", {}, {}, [])
    assert (found.explained, found.structure) == (0.0, 0.0)
    assert found.held_out_error is None
    assert found.probability == pytest.approx(1 / (1 + np.exp(1.0 - 4.5)))
    made.search.refused = (candidate(FIRST, 4.5), candidate(SECOND, 3.5))
    assert made.judged().probability == pytest.approx(1 / (1 + 1 + np.exp(-1.0)))
    made.search.refused = ()
    assert made.judged().probability == 1.0
    made.search.refused = (candidate(FIRST, 1e6),)
    assert made.judged().probability == pytest.approx(1 / (1 + np.exp(60.0)), rel=1e-9, abs=0)


def test_probabilities_of_rivals():
    assert shares([]) == {"": 1.0}
    found = shares([candidate(FIRST, 20.0), candidate(SECOND, 17.4), candidate("potentiation", -1e9)])
    weights = {FIRST: 1.0, SECOND: np.exp(-1.0), "potentiation": np.exp(-60.0), "": np.exp(4.5 - 20.0)}
    total = sum(weights.values())
    assert found == pytest.approx({name: 0.96 * weight / total for name, weight in weights.items()}, rel=1e-9, abs=0)
    low = shares([candidate(FIRST, -2.0), candidate(SECOND, -4.0)])
    assert low[SECOND] / low[FIRST] == pytest.approx(np.exp(-1.0)), "a negative gain does not narrow the spread"
    assert low[""] / low[FIRST] == pytest.approx(np.exp(6.5))
    assert shares([candidate(FIRST, 1e6)])[""] == pytest.approx(0.96 * np.exp(-60.0), rel=1e-9, abs=0)
    assert shares([candidate(FIRST, -1e6)])[FIRST] == pytest.approx(0.96 * np.exp(-60.0), rel=1e-9, abs=0)


def test_an_effect_missing(made: Made):
    found = made.add(FIRST, 50.0, 80.0, rival=48.0).leaves(ratio=3.0).judged()
    assert found.kind == "effect_missing"
    assert found.explained == pytest.approx(0.8)
    assert found.structure == 3.0
    assert found.rivals == {FIRST: shares([candidate(FIRST, 50.0), candidate("potentiation", 48.0)])}
    assert found.probabilities == {FIRST: found.rivals[FIRST][FIRST]}
    assert found.probability == found.probabilities[FIRST]


def test_what_was_added_later_stands_on_what_was_added_before(made: Made):
    made.add(FIRST, 50.0, 40.0, rival=50.0).add(SECOND, 90.0, 90.0)
    first = made.search.steps[1]
    made.search.steps[1] = replace(first, tried=(*first.tried, candidate(SECOND, 49.0)))  # no rival in this round
    found = made.judged()
    assert found.rivals[SECOND][SECOND] > 0.9
    assert found.probabilities[SECOND] == found.probabilities[FIRST] == found.rivals[FIRST][FIRST] < 0.5
    assert set(found.rivals[FIRST]) == {FIRST, "potentiation", ""}
    assert found.probability == found.probabilities[FIRST]


def test_effects_seen_in_the_raw_samples_are_almost_certain(made: Made):
    made.detect("mains_hum", 30.0)
    found = made.judged()
    assert (found.kind, found.probabilities, found.probability) == ("effect_missing", {"mains_hum": 0.99}, 0.99)
    made.add(FIRST, 50.0, 65.0)
    assert made.judged().explained == pytest.approx(35.0 / 70.0), "what was given counts as known"


EFFORTS = {f"centre_{i}": 10.0 * i for i in range(3)} | {"width_0": 1.0, "decay_0": 1.0}


def trembling(made: Made, busy_nm: float, ratio: float, wave_s: float = 1.0) -> None:
    """Explained is what it took of the power above the white noise, 0.2 N·m here, of 0.3 N·m before."""
    made.left_by_first = made.left(busy_nm=0.3, white_nm=0.2)
    made.add(TREMOR, 50.0, 90.0, wave_s=wave_s).leaves(ratio=ratio, busy_nm=busy_nm, white_nm=0.2)
    made.last.noise = replace(made.last.noise, band=0.5)
    assert made.judged().explained == pytest.approx(1 - (busy_nm**2 - 0.04) / 0.05)


RULES: dict[str, tuple[Callable[..., Any], list[tuple[Any, ...]], list[tuple[Any, ...]]]] = {
    "structure that no effect explains": (lambda made, ratio: made.leaves(ratio=ratio), [(10.1,)], [(10.0,)]),
    # 0.4 N·m are 0.15 % of 266.7. A record of many samples shows every trifle, as a pulse a millisecond late.
    "an error too small to matter": (
        lambda made, busy_nm, white_nm, scale_nm: made.leaves(
            ratio=100.0, busy_nm=busy_nm, white_nm=white_nm, scale_nm=scale_nm
        ),
        [(0.5, 0.3, 266.0)],
        [(0.5, 0.3, 267.0), (0.3, 0.5, 1.0)],  # the last one is less than noise
    ),
    "effects explain too little": (
        lambda made, likelihood, ratio: made.add(FIRST, 50.0, likelihood).leaves(ratio=ratio),
        [(74.0, 10.1)],
        [(75.0, 10.1), (74.0, 10.0)],
    ),
    "readings are held": (Made.held, [(0.0501,)], [(0.05,)]),
    "a tremor takes most of the power": (trembling, [(0.0455**0.5, 10.1)], [(0.0445**0.5, 10.1), (0.0455**0.5, 10.0)]),
}
"""By what is meant: how it is made, values at which something else is missing, and values at which nothing else is."""


@pytest.mark.parametrize(
    ("rule", "values", "strange"),
    [(rule, values, values in more) for rule, (_, more, less) in RULES.items() for values in [*more, *less]],
)
def test_every_rule_at_both_sides(made: Made, rule: str, values: tuple[Any, ...], strange: bool):
    RULES[rule][0](made, *values)
    found = made.judged()
    assert (found.kind == "unexplained_structure") is strange
    assert not strange or found.probability == 0.9
    assert not strange or all(probability <= 0.45 for probability in found.probabilities.values())


def test_what_is_left_is_told(made: Made):
    for ratio in (10.0, 10.1):
        made.leaves(ratio=ratio)
        assert made.judged().structure == ratio
    assert made.judged().notes == []
    assert made.held(0.0125).judged().notes == [
        "The recorder holds each reading for 5 samples: the noise is that of the readings."
    ]


def test_an_effect_against_which_rows_not_seen_speak_is_doubted(made: Made):
    made.add(FIRST, 50.0, 80.0).add(SECOND, 50.0, 90.0)
    made.rises = {1}
    found = made.judged()
    assert found.probabilities[SECOND] == 0.45
    assert found.probabilities[FIRST] > 0.9
    assert len(found.notes) == 1
    assert found.notes[0].endswith(f": {find_effect(SECOND).name}.")


@pytest.mark.parametrize(
    ("before", "after", "contradicted"),
    [
        (None, HeldOutError(2.5, 1.0), True),
        (None, HeldOutError(2.4, 1.0), False),
        (HeldOutError(4.0, 1.0), HeldOutError(2.5, 1.0), True),
        (HeldOutError(9.0, 1.0), HeldOutError(2.5, 1.0), False),
        (HeldOutError(9.0, 1.0), None, False),
    ],
)
def test_rows_not_seen_may_contradict(
    made: Made, before: HeldOutError | None, after: HeldOutError | None, contradicted: bool
):
    made.unseen = [before, after]
    found = made.judged()
    assert found.held_out_error is after
    assert (found.kind == "unexplained_structure") is contradicted
    assert len(found.notes) == contradicted
    if contradicted:
        assert found.notes == [
            "On held-out pulses the error of the last model is 2.5 times what noise and its uncertainty allow: "
            "something is still missing."
        ]


def test_half_of_what_the_plain_structure_leaves_is_not_too_much(made: Made):
    first = HeldOutError(float(np.sqrt(1 + 4 * 8.0)), 1.0)
    made.unseen = [first, HeldOutError(3.0, 1.0)]  # both excesses squared: 32 and 8
    assert made.judged().notes == []
    made.unseen = [first, HeldOutError(3.01, 1.0)]
    assert len(made.judged().notes) == 1


@pytest.mark.parametrize(
    ("at_rest", "name", "kind", "probability"),
    [
        (0.15, "bumps", "effect_missing", 0.86),
        (0.15, "resisting bumps", "effect_missing", 0.86),
        (0.14, "bumps", "effect_missing", 0.85),
        (0.14, "resisting bumps", "unexplained_structure", None),
    ],
)
def test_efforts_seen_nowhere_at_rest_are_less_certain(
    made: Made, at_rest: float, name: str, kind: str, probability: float | None
):
    made.at_rest = at_rest
    made.add(EFFORT, 50.0, 90.0, **EFFORTS).last.effects[0][1].name = name
    found = made.judged()
    assert found.kind == kind
    if probability == 0.85:
        assert found.probabilities[EFFORT] == 0.85
    elif probability:
        assert found.probabilities[EFFORT] > 0.85


def test_efforts_are_looked_for_in_the_model_to_which_they_were_added(made: Made):
    made.at_rest = 0.14
    found = made.add(EFFORT, 50.0, 80.0, **EFFORTS).add(FIRST, 50.0, 90.0).judged()
    assert found.probabilities == {EFFORT: 0.85, FIRST: 0.85}


@pytest.mark.parametrize(("wave_s", "doubted"), [(0.29, True), (0.31, False)])
def test_a_tremor_that_dies_away_too_soon_is_doubted(made: Made, wave_s: float, doubted: bool):
    trembling(made, 0.22, 3.0, wave_s)
    found = made.judged()
    assert ("a limb may swing" in found.objections.get(TREMOR, "")) is doubted
    assert (found.probabilities[TREMOR] <= 0.45) is doubted


def test_a_law_that_shows_nothing_at_rest_is_as_certain_as_ever(made: Made):
    made.at_rest = 0.0
    assert made.add("baseline_drift", 50.0, 90.0).judged().probabilities["baseline_drift"] > 0.9


def test_a_structure_that_holds_effects_is_measured_from_the_plain_one(made: Made):
    made.search.steps = [Step(None, fitted(60.0, FIRST), "base")]
    found = made.judged()
    assert found.explained == pytest.approx(0.6)
    assert found.kind == "nothing_missing"


def test_little_to_explain_is_not_divided_by(made: Made):
    made.add(FIRST, 6.0, 0.5)
    made.leaves(ideal=-19.9)
    assert made.judged().explained == pytest.approx(0.5)


@pytest.mark.parametrize(("names", "kind"), [((), "unexplained_structure"), ((FIRST,), "effect_missing")])
def test_terms_beside_no_name_leave_the_cause_open(made: Made, names: tuple[str, ...], kind: str):
    for name in names:
        made.add(name, 50.0, 90.0)
    made.search.steps.append(Step("free_strength_by_drive", fitted(95.0, *names, "free_strength_by_drive"), "free"))
    assert made.judged().kind == kind
    assert made.judged().probabilities.keys() == {*names}


def test_the_model_of_a_step_lacks_what_was_added_after_it(made: Made):
    made.add(FIRST, 50.0, 60.0).add(SECOND, 20.0, 90.0)
    whole = made.judged()
    later = judge(made.search.from_step(1))
    assert later.probabilities == {SECOND: whole.probabilities[SECOND]}
    assert judge(made.search.from_step(2)).kind == "nothing_missing"

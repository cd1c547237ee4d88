"""The verdict's own arithmetic, on analyses made by hand: every rule at both sides of its threshold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from stimrig.identify.diagnosis import objections, search, verdict
from stimrig.identify.diagnosis import probability as probabilities
from stimrig.identify.diagnosis.free import without_doubted
from stimrig.identify.diagnosis.probability import probability, scores_of_effect, scores_of_remainder, weights
from stimrig.identify.diagnosis.residual import HeldOutError, Remainder, ResidualStructure
from stimrig.identify.diagnosis.search import EffectSearch, Step
from stimrig.identify.diagnosis.verdict import judge, remainder_of, shares
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.effect_fit import Candidate
from stimrig.identify.noise import NoiseLevel
from stimrig.identify.records.readings import Readings

FIRST, SECOND, EFFORT, TREMOR = "fatigue", "output_saturation", "voluntary_effort", "tremor"


def candidate(effect: str, gain: float) -> Any:
    return Candidate(find_effect(effect), find_effect(effect).forms[0], cast("Any", None), gain, {})


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
        rms_nm=2.0,
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
            raw=self.raw, rows=np.ones(4000, bool), plain=base, steps=[Step(None, base, "base")],
            quiet=np.zeros(4000, bool), refused=(candidate(FIRST, 1.0),),
        )  # fmt: skip
        monkeypatch.setattr(search, "share_at_rest", self._share_at_rest)
        for module in (search, verdict):
            monkeypatch.setattr(module, "residual_structure", self._residual)
        monkeypatch.setattr(verdict, "objection_to", lambda *_: None)
        monkeypatch.setattr(probabilities, "at_bounds", lambda *_: [])
        monkeypatch.setattr(verdict, "contradiction", lambda _fitted: None)
        monkeypatch.setattr(EffectSearch, "in_samples", {"mains_hum"})
        monkeypatch.setattr(Step, "left_out", None)
        monkeypatch.setattr(probabilities, "hold_out", lambda _fitted: None)
        monkeypatch.setattr(probabilities, "difference", lambda *_: SimpleNamespace(errors=3.0, gain=0.5))
        monkeypatch.setattr(verdict, "held_out_error", self._unseen)

    def left(
        self,
        ratio: float = 0.0,
        ideal: float = 80.0,
        busy_nm: float = 1.0,
        white_nm: float = 1e-3,
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

    def left_over(self) -> Remainder:
        return remainder_of(self.search)

    def ended(self, **changes: Any) -> EffectSearch:
        """The search with what its last model leaves."""
        self.search.known = replace(self.left_over(), **changes)
        return self.search

    def scores(self, effect: str) -> dict[str, float]:
        search = self.ended()
        before, step = next(pair for pair in search.found if pair[1].added == effect)
        return scores_of_effect(search, before, step, verdict._rivals(search, step)[effect], False)

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


def test_probabilities_of_rivals():
    assert shares([]) == {"": 1.0}
    found = shares([candidate(FIRST, 20.0), candidate(SECOND, 17.4), candidate("potentiation", -1e9)])
    weights = {FIRST: 1.0, SECOND: np.exp(-1.0), "potentiation": np.exp(-60.0), "": np.exp(4.5 - 20.0)}
    total = sum(weights.values())
    assert found == pytest.approx({name: weight / total for name, weight in weights.items()}, rel=1e-9, abs=0)
    low = shares([candidate(FIRST, -2.0), candidate(SECOND, -4.0)])
    assert low[SECOND] / low[FIRST] == pytest.approx(np.exp(-1.0)), "a negative gain does not narrow the spread"
    assert low[""] / low[FIRST] == pytest.approx(np.exp(6.5))
    assert shares([candidate(FIRST, 1e6)])[""] == pytest.approx(np.exp(-60.0), rel=1e-9, abs=0)
    assert shares([candidate(FIRST, -1e6)])[FIRST] == pytest.approx(np.exp(-60.0), rel=1e-9, abs=0)


EFFORTS = {f"centre_{i}": 10.0 * i for i in range(3)} | {"width_0": 1.0, "decay_0": 1.0}


def trembling(made: Made, busy_nm: float, ratio: float, wave_s: float = 1.0) -> None:
    """Explained is what it took of the power above the white noise, 0.2 N·m here, of 0.3 N·m before."""
    made.left_by_first = made.left(busy_nm=0.3, white_nm=0.2)
    made.add(TREMOR, 50.0, 90.0, wave_s=wave_s).leaves(ratio=ratio, busy_nm=busy_nm, white_nm=0.2)
    made.last.noise = replace(made.last.noise, band=0.5)
    assert made.left_over().explained == pytest.approx(1 - (busy_nm**2 - 0.04) / 0.05)


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
    assert made.left_over().structure is strange


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
    found = made.left_over()
    assert found.held_out is after
    assert found.structure is contradicted
    told = "On held-out pulses the error of the last model is 2.5 times what noise and its uncertainty allow: "
    assert found.notes == ((f"{told}something is still missing.",) if contradicted else ())


def test_half_of_what_the_plain_structure_leaves_is_not_too_much(made: Made):
    first = HeldOutError(float(np.sqrt(1 + 4 * 8.0)), 1.0)
    made.unseen = [first, HeldOutError(3.0, 1.0)]  # both excesses squared: 32 and 8
    assert made.left_over().notes == ()
    made.unseen = [first, HeldOutError(3.01, 1.0)]
    assert len(made.left_over().notes) == 1


@pytest.mark.parametrize(
    ("at_rest", "name", "structure"),
    [(0.15, "bumps", False), (0.15, "resisting bumps", False), (0.14, "bumps", False), (0.14, "resisting bumps", True)],
)
def test_efforts_that_resist_and_do_not_appear_at_rest_are_structure(
    made: Made, at_rest: float, name: str, structure: bool
):
    made.at_rest = at_rest
    made.add(EFFORT, 50.0, 90.0, **EFFORTS).last.effects[0][1].name = name
    assert made.left_over().structure is structure
    assert made.scores(EFFORT)["at rest"] == -float(at_rest < 0.15)


def test_a_structure_that_holds_effects_is_measured_from_the_plain_one(made: Made):
    made.search.steps = [Step(None, fitted(60.0, FIRST), "base")]
    assert made.left_over().explained == pytest.approx(0.6)


def test_what_was_given_counts_as_known(made: Made):
    made.detect("mains_hum", 30.0)
    made.add(FIRST, 50.0, 65.0)
    assert made.left_over().explained == pytest.approx(35.0 / 70.0)


def test_little_to_explain_is_not_divided_by(made: Made):
    made.add(FIRST, 6.0, 0.5)
    made.leaves(ideal=-19.9)
    assert made.left_over().explained == pytest.approx(0.5)


# ---- probabilities --------------------------------------------------------------------------------------------------


def test_no_score_speaks_against_what_it_should_speak_for():
    for statement, known in weights().items():
        assert all(weight >= 0.0 for name, weight in known.items() if name), statement


def test_each_score_has_a_weight_and_each_weight_a_score(made: Made):
    made.add(FIRST, 50.0, 80.0, rival=48.0)
    assert {*made.scores(FIRST), ""} == weights()["missing"].keys()
    assert {*scores_of_remainder(made.ended()), ""} == weights()["left"].keys()


@pytest.mark.parametrize(
    ("change", "score"),
    [
        (lambda made: made.add(SECOND, 90.0, 90.0, rival=80.0), "rivals"),
        (lambda made: made.leaves(ratio=9.0).add(SECOND, 90.0, 90.0), "no work and rest"),
    ],
)
def test_what_speaks_against_an_effect_makes_it_less_probable(made: Made, change: Callable[..., Any], score: str):
    sure = made.add(FIRST, 90.0, 90.0).scores(FIRST)
    made.search.steps = made.search.steps[:1]
    change(made)
    less_sure = made.scores(SECOND)
    assert less_sure[score] < sure[score]
    assert probability("missing", less_sure) < probability("missing", sure)


def stated(monkeypatch: pytest.MonkeyPatch, left: float, *names: float) -> None:
    """Let the probabilities be these: that something else is missing, and of the effects in turn."""
    given = iter(names)
    monkeypatch.setattr(
        verdict, "probability", lambda statement, _: {"left": left, "seen": 0.98}.get(statement) or next(given)
    )


@pytest.mark.parametrize(
    ("left", "names", "structure", "kind", "certainty"),
    [
        (0.1, (), False, "nothing_missing", 0.9),
        (0.6, (), False, "unexplained_structure", 0.6),
        (0.2, (0.95,), False, "effect_missing", 0.95),
        (0.2, (0.7, 0.9), False, "effect_missing", 0.9),
        (0.8, (0.95,), True, "unexplained_structure", 0.8),
        (0.7, (0.4,), False, "unexplained_structure", 0.82),
        (0.1, (0.3,), False, "nothing_missing", 0.63),
    ],
)
def test_the_verdict_follows_from_the_probabilities(
    made: Made,
    monkeypatch: pytest.MonkeyPatch,
    left: float,
    names: tuple[float, ...],
    structure: bool,
    kind: str,
    certainty: float,
):
    for effect in (FIRST, SECOND)[: len(names)]:
        made.add(effect, 50.0, 90.0)
    made.ended(structure=structure)
    stated(monkeypatch, left, *names)
    found = judge(made.search)
    assert (found.kind, found.probability) == (kind, pytest.approx(certainty))
    assert list(found.probabilities.values()) == list(names)


def test_of_an_effect_that_is_doubted_the_model_is_not_given(made: Made, monkeypatch: pytest.MonkeyPatch):
    made.add(FIRST, 50.0, 60.0).add(SECOND, 20.0, 90.0)
    given = {FIRST: 0.9, SECOND: 0.3}
    monkeypatch.setattr(verdict, "scores_of_effect", lambda _search, _before, step, *_: step.added)
    monkeypatch.setattr(verdict, "probability", lambda statement, name: given[name] if statement == "missing" else 0.1)
    search = without_doubted(made.ended())
    assert search.names("library") == [FIRST] and [step.added for step in search.doubted] == [SECOND]
    found = judge(search)
    assert found.kind == "effect_missing" and found.probabilities == {FIRST: 0.9}
    rest = judge(search.from_step(1))
    assert (rest.kind, rest.probability) == ("nothing_missing", pytest.approx(0.9 * 0.7)), "its chance is not lost"
    assert rest.nothing == rest.probability
    (refused,) = [each for each in search.refused if each.effect.id == SECOND]
    assert "mostly where it was not there" in refused.refusal


@pytest.mark.parametrize("names", [(), (FIRST,)])
def test_where_terms_are_found_the_verdict_is_never_that_nothing_is_missing(
    made: Made, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
):
    for name in names:
        made.add(name, 50.0, 90.0)
    made.search.steps.append(Step("free_strength_by_drive", fitted(95.0, *names, "free_strength_by_drive"), "free"))
    made.ended()
    stated(monkeypatch, 0.2, *[0.9] * len(names))
    assert judge(made.search).kind == ("effect_missing" if names else "unexplained_structure")


def test_the_model_of_a_step_lacks_what_was_added_after_it(made: Made):
    made.add(FIRST, 50.0, 60.0).add(SECOND, 20.0, 90.0)
    whole = judge(made.ended())
    assert judge(made.search.from_step(1)).probabilities == {SECOND: whole.probabilities[SECOND]}
    assert judge(made.search.from_step(2)).remaining == whole.remaining


# ---- what speaks against an effect ----------------------------------------------------------------------------------


def waves(hz: float, wave_s: float = 1.0) -> tuple[Any, Any]:
    """Steps before and with a tremor, in a PRBS of four pulses a level and a ramp."""
    width_us = np.r_[np.repeat(np.random.default_rng(1).integers(0, 2, 100) * 300.0, 4), np.arange(80.0)]
    grid = SimpleNamespace(step_s=0.025, pulse_width_us=width_us)
    noise = NoiseLevel(0.5, 0.5, 1.0, turn=2 * np.pi * hz * 0.025, decay=1.0 - 0.025 / wave_s, band=0.5)
    model = SimpleNamespace(noise=noise, problem=SimpleNamespace(setup=SimpleNamespace(grid=grid)))
    return SimpleNamespace(searched=None), SimpleNamespace(added=TREMOR, searched=model)


@pytest.mark.parametrize(
    ("hz", "wave_s", "words"),
    [(8.7, 1.0, ""), (10.05, 1.0, "10.1 Hz, is that at which"), (8.7, 0.29, "a limb may swing"), (8.7, 0.31, "")],
)
def test_a_wave_that_the_pulses_may_cause_is_doubted(
    monkeypatch: pytest.MonkeyPatch, hz: float, wave_s: float, words: str
):
    monkeypatch.setattr(objections, "vetoed", lambda *_: None)
    assert words in (said := objections.objection_to(*waves(hz, wave_s)) or "") and bool(said) is bool(words)


@pytest.mark.parametrize(
    ("within", "at_bound"), [(0.0, True), (0.002, False), (0.5, False), (0.998, False), (1.0, True)]
)
def test_a_parameter_at_its_bound_is_told(within: float, at_bound: bool):
    """`within`: the place in its range, on its own scale."""
    effect = find_effect("mixed_fibres")
    form = next(form for form in effect.forms if any(p.name == "ratio" for p in form.parameters))
    values = [0.5 * (p.lower + p.upper) for p in form.parameters]
    place, ratio = next((i, p) for i, p in enumerate(form.parameters) if p.name == "ratio")
    low, high = (np.log(x) if ratio.scale == "log" else x for x in (ratio.lower, ratio.upper))
    value = low + within * (high - low)
    values[place] = float(np.exp(value) if ratio.scale == "log" else value)
    chosen = SimpleNamespace(effect=effect.id, form=form, places=range(len(values)), parameters=form.parameters)
    model: Any = SimpleNamespace(problem=SimpleNamespace(chosen=[chosen]), physical=np.array(values))
    assert objections.at_bounds(model, effect.id) == [f"{ratio.about} {values[place]:.3g}"] * at_bound

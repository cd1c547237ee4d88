"""Which terms are chosen and kept as rivals, on models made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stimrig.identify.diagnosis import candidate_terms, free, search
from stimrig.identify.diagnosis.search import EffectSearch, Step, silent
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.effect_fit import Candidate

NAMED, TERM = "fatigue", "free_width_by_torque"


def model(log_evidence: float, *effects: str) -> Any:
    noise = SimpleNamespace(band=0.0)
    return SimpleNamespace(
        log_evidence=log_evidence, effects=[(name, None) for name in effects], noise=noise, problem=None, theta=None
    )


@pytest.fixture
def made_by_hand(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """No model is fitted again, and left-out blocks and held-out pulses ask for every term."""
    monkeypatch.setattr(free, "fix_noise", lambda fitted: fitted)
    monkeypatch.setattr(free, "vetoed", lambda *_: None)
    monkeypatch.setattr(free, "_better", lambda _, after: SimpleNamespace(gain=float(len(after)), errors=9.0))
    return monkeypatch


def test_the_rivals_of_a_term_are_the_likeliest_others(made_by_hand: pytest.MonkeyPatch) -> None:
    gains = {"free_width_by_drive": 7.0, TERM: 9.0, "free_width_by_pulses": 5.0, "free_torque_by_drive": 8.0}
    rounds = iter([[model(gain, name) for name, gain in gains.items()], []])
    made_by_hand.setattr(free, "fit_terms", lambda *_: next(rounds))
    best = model(9.0, TERM)
    made_by_hand.setattr(free, "solve", lambda *_: best)
    step = free._extended((Step(None, model(0.0), "base"),), silent)[-1]
    assert step.added == TERM
    assert [rival.effects[0][0] for rival in step.others] == ["free_torque_by_drive", "free_width_by_drive"]


FIRST, SECOND = "free_strength_by_drive", "free_strength_by_torque"


@pytest.mark.parametrize(("errors", "kept"), [(-1.4, [TERM]), (-1.6, [FIRST, SECOND, TERM])])
def test_a_term_that_a_later_one_made_superfluous_is_taken_out(
    errors: float, kept: list[str], made_by_hand: pytest.MonkeyPatch
) -> None:
    models = [model(9.0, FIRST), model(20.0, FIRST, SECOND), model(30.0, FIRST, SECOND, TERM)]
    rounds, steps = iter(models), iter(models)
    made_by_hand.setattr(free, "fit_terms", lambda *_: [next(rounds, models[-1])])
    made_by_hand.setattr(free, "solve", lambda *_: next(steps, models[-1]))

    def leave(fitted: Any, name: str) -> Any:
        return model(fitted.log_evidence, *(other for other, _ in fitted.effects if other != name))

    made_by_hand.setattr(free, "without_effect", leave)
    made_by_hand.setattr(
        free, "_better", lambda before, after: SimpleNamespace(gain=float(len(after) - len(before)), errors=errors)
    )
    chain = free._extended((Step(None, model(0.0), "base"),), silent)[1:]
    assert [step.added for step in chain] == [name for name, _ in chain[-1].searched.effects] == kept


@pytest.mark.parametrize(("by_names", "found"), [(49.0, [TERM]), (51.0, [])])
def test_terms_take_the_place_of_names_that_explain_less_than_half(
    by_names: float, found: list[str], made_by_hand: pytest.MonkeyPatch
) -> None:
    base, named = Step(None, model(0.0), "base"), Step(NAMED, model(by_names, NAMED), "library")
    term = Step(TERM, model(100.0, TERM), "free")
    made_by_hand.setattr(free, "_extended", lambda chain, _: chain if chain[-1] is named else (*chain, term))
    raw: Any = None
    found_first = EffectSearch(raw, np.ones(9, bool), base.searched, [base, named], np.zeros(9, bool))
    freely = free.explain_freely(found_first, [base, named], silent)
    assert freely.names("free") == found and freely.names("library") == ([] if found else [NAMED])


@pytest.mark.parametrize(("gain", "found"), [(0.1, [TERM]), (-0.1, [])])
def test_terms_replace_what_was_found_only_if_they_predict_better(
    gain: float, found: list[str], made_by_hand: pytest.MonkeyPatch
) -> None:
    """A zero that wanders over a plain muscle was told as a term, where a drift had been found and was not named."""
    base, drift = Step(None, model(0.0), "base"), Step("baseline_drift", model(90.0, "baseline_drift"), "library")
    term = Step(TERM, model(40.0, TERM), "free")
    better = {base: 1.0, drift: gain}
    made_by_hand.setattr(free, "_better", lambda before, _: SimpleNamespace(gain=better[before[-1]], errors=9.0))
    made_by_hand.setattr(free, "_fix_noise", lambda chain: chain)
    made_by_hand.setattr(free, "_extended", lambda chain, _: (*chain, term))
    raw: Any = None
    found_first = EffectSearch(raw, np.ones(9, bool), base.searched, [base, drift], np.zeros(9, bool))
    assert free.explain_freely(found_first, (), silent).names("free") == found


def test_the_size_of_a_term_is_cut_no_further_once_it_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The base itself runs away here, with any size."""
    begun, runs = np.array([2.0, 0.5]), iter([(None, np.full((2, 3), np.inf))] * 20)
    problem = SimpleNamespace(chosen=[SimpleNamespace(first=1)], run=lambda *_, **__: next(runs))
    monkeypatch.setattr(candidate_terms, "_with_term", lambda *_: problem)
    monkeypatch.setattr(candidate_terms, "start_from", lambda *_: begun)
    monkeypatch.setattr(candidate_terms, "solve", lambda _problem, start, *_, **__: start)
    start = candidate_terms.fit_term(model(0.0), find_effect(TERM), {})
    assert start[0] == 2.0 and 0.0 < start[1] <= candidate_terms.LEAST_SIZE


def test_a_refused_effort_does_not_come_back_beside_a_later_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(search, "without_effect", lambda *_: SimpleNamespace(log_evidence=0.0, residual_nm=None))
    monkeypatch.setattr(search, "fit_form", lambda effect, *_: asked.append(effect.id))
    refused = [find_effect(name) for name in ("voluntary_effort", "potentiation")]
    tried = tuple(Candidate(effect, effect.forms[0], model(0.0), 9.0, {}, "It must not rise.") for effect in refused)
    steps = [Step(None, model(0.0), "base"), Step(NAMED, model(50.0, NAMED), "library", tried)]
    steps.append(Step("catch_like", model(90.0, NAMED, "catch_like"), "library"))
    raw: Any = None
    search._exchange(EffectSearch(raw, np.ones(9, bool), steps[0].searched, steps, np.zeros(9, bool)))
    assert asked == ["potentiation"]

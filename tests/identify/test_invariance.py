"""What must not change the answer: the counting of torque, the clock, the sampling, and rows that were not needed.

The fit is of the plain structure, so with something hidden its figures may move a little with the rows it sees: how
much is stated for each relation. Relations that do not hold are here too, as strict failures with their figures.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from stimrig.identify import Record, fit
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.model import Model
from stimrig.identify.records.record import Pulses
from tests.harness import answers, few_effects
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow

HIDDEN = ("", "fatigue", "asymmetric_relaxation", "electromechanical_delay", "output_saturation", "threshold_drift")
SEED, RATE_HZ = 11, 100
WIDTHS_US = np.linspace(0.0, hidden_muscles.TOP_US, 31)


def torque(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Record], Record]:
    return lambda record: record.with_torque(change(record.torque_nm))


def kept(choose: Callable[[Record], np.ndarray]) -> Callable[[Record], Record]:
    return lambda record: record.take(choose(record))


def later(record: Record) -> Record:
    return replace(record, time_s=record.time_s + 1e4)


def counted(record: Record) -> Record:
    return record.with_torque(np.round(record.torque_nm / 0.005) * 0.005)


def told(record: Record) -> Record:
    """The same with its pulses known, as those of a sealed recording are: a gap then hides nothing that was applied."""
    slot_s = np.arange(round((record.time_s[-1] - record.time_s[0]) * 40)) / 40 + record.time_s[0]
    width = record.pulse_width_us[np.searchsorted(record.time_s, slot_s - 1e-9)]
    return replace(record, pulses=Pulses(slot_s, width, np.zeros(slot_s.size), np.zeros(slot_s.size, bool)))


def without(segment: int, *, pulses: bool) -> Callable[[Record], Record]:
    return lambda record: (told(record) if pulses else record).take(record.segment != segment)


FIRST_REST, PRBS, MIDDLE_REST, RAMP, LAST_REST, VALIDATE = range(6)

COUNTING = {
    "50 N·m above": (torque(lambda y: y + 50.0), 1.0, 50.0),
    "50 N·m below": (torque(lambda y: y - 50.0), 1.0, -50.0),
    "a tenth": (torque(lambda y: 0.1 * y), 0.1, 0.0),
    "ten times": (torque(lambda y: 10.0 * y), 10.0, 0.0),
    "the other way": (torque(lambda y: -y), -1.0, 0.0),
    "1e4 s later": (later, 1.0, 0.0),
}
"""Changes of how torque and time are counted, with the factor and the offset of torque then: nothing else moves."""

SAMPLING = {
    "in 5 mN·m": counted,
    "begun in the PRBS": kept(lambda r: r.time_s >= 4.3),
    "a gap of 0.5 s": kept(lambda r: ~((r.time_s > 8.0) & (r.time_s < 8.5))),
    "every second sample": kept(lambda r: np.arange(r.time_s.size) % 2 == 0),
    "without the first rest": without(FIRST_REST, pulses=False),
    "without the middle rest": without(MIDDLE_REST, pulses=True),
    "without the last rest": without(LAST_REST, pulses=True),
    "without validate": without(VALIDATE, pulses=False),
}
"""Other samples of the same muscle: what is estimated moves within what the rows leave open."""


@cache
def record_of(hidden: str) -> Record:
    return hidden_muscles.record(hidden, seed=SEED, rate_hz=RATE_HZ)


@cache
def fitted(hidden: str, *effects: str) -> Model:
    return fit(record_of(hidden), effects=effects)


def said(hidden: str, change: Callable[[Record], Record] = lambda record: record) -> tuple[str, str, float]:
    """Verdict, what is named first, and its probability, of a library with what is hidden and one effect of each kind.

    That is, of the gain, the pulse width and the zero.
    """
    with few_effects.only(*dict.fromkeys([*filter(None, [hidden]), "fatigue", "threshold_drift", "baseline_drift"])):
        result = diagnose(change(record_of(hidden)))
    first = result.missing[0] if result.missing else {"effect": "", "probability": 0.0}
    return result.verdict, str(first["effect"]), float(first["probability"])


answer = cache(said)


def moved(model: Model, base: Model, factor: float = 1.0) -> dict[str, float]:
    """By how much a fit moved: shares of time constant, damping and the curve's range, and the delay in s."""
    curve = base.recruitment(WIDTHS_US)
    return {
        "time_constant": abs(model.linear.time_constant_s / base.linear.time_constant_s - 1.0),
        "damping": abs(model.linear.damping / base.linear.damping - 1.0),
        "delay_s": abs(model.linear.delay_s - base.linear.delay_s),
        "curve": float(np.max(np.abs(model.recruitment(WIDTHS_US) / factor - curve)) / np.ptp(curve)),
    }


# ---- the fit ------------------------------------------------------------------------------------------------


def whole_grid(cases: list[tuple[str, ...]], always: set[tuple[str, ...]]) -> list:
    """All cases; those that are not of `always` are for a campaign."""
    assert always <= set(cases)
    return [pytest.param(*case, marks=[] if case in always else [pytest.mark.campaign]) for case in cases]


@pytest.mark.parametrize(
    ("hidden", "relation"),
    whole_grid(
        [(hidden, relation) for hidden in HIDDEN for relation in COUNTING],
        {*(("", relation) for relation in COUNTING), *((hidden, "the other way") for hidden in HIDDEN)},
    ),
)
def test_fit_does_not_depend_on_how_torque_and_time_are_counted(hidden, relation):
    change, factor, offset_nm = COUNTING[relation]
    record, base = change(record_of(hidden)), fitted(hidden)
    model = fit(record)
    found = moved(model, base, factor)
    found["baseline"] = abs(model.baseline_nm - factor * base.baseline_nm - offset_nm)
    found["fit"] = abs(model.fit["fit_percent"] - base.fit["fit_percent"])
    wanted_nm = factor * base.predict(record_of(hidden)) + offset_nm
    found["prediction"] = float(np.max(np.abs(model.predict(record) - wanted_nm)))
    assert max(found.values()) < 1e-6, found


DELAY_SHORT_OF_A_SAMPLE = pytest.mark.xfail(
    strict=True,
    reason="the plain structure's delay ends at a sample, so a hidden delay of 45 ms bends T by -7.7 %, ζ by +13 % "
    "and the delay by 10 ms once a sample is 20 ms",
)


def _fits() -> list:
    cases = []
    for hidden in HIDDEN:
        for relation in SAMPLING:
            bent = (hidden, relation) == ("electromechanical_delay", "every second sample")
            marks = [] if hidden in ("", "fatigue") or bent else [pytest.mark.campaign]
            cases.append(pytest.param(hidden, relation, marks=[*marks, *([DELAY_SHORT_OF_A_SAMPLE] if bent else [])]))
    return cases


@pytest.mark.parametrize(("hidden", "relation"), _fits())
def test_fit_hardly_depends_on_which_samples_show_the_muscle(hidden, relation):
    found = moved(fit(SAMPLING[relation](record_of(hidden))), fitted(hidden))
    allowed = {"time_constant": 0.005, "damping": 0.005, "delay_s": 5e-4, "curve": 0.003}
    if hidden:  # the plain structure is wrong then, and which wrong one is best depends on the rows
        allowed = {"time_constant": 0.015, "damping": 0.025, "delay_s": 1e-3, "curve": 0.03}
    assert all(found[name] <= allowed[name] for name in found), found


BY_TURNS = ("begun in the PRBS", "a gap of 0.5 s", "every second sample")


@pytest.mark.parametrize(
    ("hidden", "relation"),
    whole_grid(
        [(hidden, relation) for hidden in HIDDEN[1:] for relation in BY_TURNS],
        set(zip(("fatigue", "threshold_drift", "electromechanical_delay"), BY_TURNS, strict=True)),
    ),
)
def test_fit_with_the_effect_hardly_depends_on_the_samples(hidden, relation):
    """Its dynamics keep to 1 %; the form may be another of the same effect, and its curve then stands a little else."""
    record = record_of(hidden)
    base = fitted(hidden, hidden)
    found = moved(fit(SAMPLING[relation](record), effects=[hidden]), base)
    # The curve is that of the muscle at the record's begin: after 2.3 s of PRBS at half duty 3.4 % of it is tired.
    curve = 0.04 if (hidden, relation) == ("fatigue", "begun in the PRBS") else 0.03
    assert found["time_constant"] < 0.01 and found["damping"] < 0.01 and found["curve"] < curve, found


# ---- the diagnosis ------------------------------------------------------------------------------------------


COUNTED: dict[str, tuple[Callable[[Record], Record], float]] = {
    "turned, ten times, lower, later": (lambda r: later(r.with_torque(-10.0 * r.torque_nm - 50.0)), 1e-3),
    "in 5 mN·m, a tenth, higher": (lambda r: counted(r).with_torque(0.1 * counted(r).torque_nm + 50.0), 0.02),
}
"""All at once, and by how much a probability may move."""
FIRST, SECOND = COUNTED


@pytest.mark.parametrize(
    ("hidden", "how"),
    whole_grid(
        [(hidden, how) for hidden in HIDDEN for how in COUNTED],
        {("", FIRST), ("fatigue", FIRST), ("threshold_drift", SECOND)},
    ),
)
def test_diagnosis_does_not_depend_on_how_torque_and_time_are_counted(hidden, how):
    change, allowed = COUNTED[how]
    assert said(hidden, change) == (*answer(hidden)[:2], pytest.approx(answer(hidden)[2], abs=allowed))


IN_EVERY_RUN = {
    ("", "a gap of 0.5 s"),
    ("fatigue", "every second sample"),
    ("threshold_drift", "without the first rest"),
    ("threshold_drift", "begun in the PRBS"),
}
RELATIONS = [(hidden, relation) for hidden in HIDDEN for relation in SAMPLING if relation != "in 5 mN·m"]


@pytest.mark.parametrize(("hidden", "relation"), whole_grid(RELATIONS, IN_EVERY_RUN))
def test_diagnosis_stays_whichever_samples_show_the_muscle(hidden, relation):
    assert said(hidden, SAMPLING[relation])[:2] == answer(hidden)[:2]


CUT = [("fatigue", PRBS, True), ("", RAMP, True), ("", PRBS, False), ("", RAMP, False), ("threshold_drift", PRBS, True)]


@pytest.mark.parametrize(("hidden", "segment", "pulses"), whole_grid(CUT, {CUT[0], CUT[3]}))
def test_without_the_prbs_or_the_ramp_whether_or_not_its_pulses_are_known(hidden, segment, pulses):
    verdict, first, chance = said(hidden, without(segment, pulses=pulses))
    assert first == answer(hidden)[1]
    assert verdict == answer(hidden)[0] or chance < answer(hidden)[2], "it may be less sure: less is known"


# ---- a nudge far below any sensor's last digit, and another processor ---------------------------------------------

NUDGE = 1.0 + 1e-9
MOST = 0.01
"""Share of what a plain fit leaves, by which its prediction may move."""
QUICK = ("fatigue", "arm 4 without rest")
"""Records of every run; a campaign takes them all."""

Answers = dict[str, dict[str, Any]]


@cache
def answered(where: str, names: tuple[str, ...]) -> Answers:
    if where == "another processor":
        return answers.answers_elsewhere()
    some = {name: answers.records()[name] for name in names or answers.records()}
    with patch.object(answers, "records", lambda: some):
        return json.loads(json.dumps(answers.answers(NUDGE if where == "nudged" else 1.0)))


@pytest.mark.parametrize(
    ("where", "names"),
    [
        ("nudged", QUICK),
        pytest.param("nudged", (), marks=pytest.mark.campaign),
        pytest.param("another processor", (), marks=pytest.mark.campaign),
    ],
)
def test_the_plain_fit_stays_and_the_same_effects_are_added(where: str, names: tuple[str, ...]) -> None:
    here, again = answered("here", names), answered(where, names)
    moved = {
        name: np.sqrt(np.mean(np.subtract(again[name]["own_nm"], one["own_nm"]) ** 2)) / one["left_nm"]
        for name, one in here.items()
    }
    assert {name: share for name, share in moved.items() if not share <= MOST} == {}
    assert moved.keys() == set(names or answers.records())
    added = [{name: one["added"] for name, one in each.items() if "added" in one} for each in (here, again)]
    assert added[0] == added[1] and "fatigue" in added[0]

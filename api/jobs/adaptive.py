"""Verbs of adaptive tests: what a test can reach, and what to play next in the one that runs.

That test stays in this process between two jobs: a job brings only the samples that are new.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.record_files import Progress
from stimrig.identify.json_text import json_value
from stimrig.identify.records.live import SAMPLE, Segments, live_record

NEW_PERSON_SHARE = 1 / 3
"""Expected torque of a new person at the largest width, as a share of the torque that stops a test."""
DIGITS = 4


def adaptive_outlook(
    progress: Progress,
    target: dict[str, float],
    playable_s: float,
    max_torque_time_nm_s: float,
    largest_us: float,
    max_torque_nm: float,
    pulse_rate_hz: float,
    models: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the opening's pulse widths, and what the test will probably reach.

    `playable_s`: for all segments, without the rest at the end; `models`: approved ones, oldest first.
    """
    from stimrig.identify.experiments.adaptive import AdaptiveGoal, decide, reach
    from stimrig.identify.experiments.knowledge import Target

    progress(0.1, "playing the test on a simulated muscle")
    limits = AdaptiveGoal(Target(**target), playable_s, max_torque_time_nm_s, largest_us, pulse_rate_hz, known(models))
    opening = decide(None, (), limits)
    widths = [width for segment in opening.segments for width in segment.settings["pulse_width_us"]]
    outlook = reach(limits, NEW_PERSON_SHARE * max_torque_nm)
    return json_value({"opening_us": widths, "reach": {**asdict(outlook), "known": limits.earlier is not None}})


def warm() -> None:
    """Have the compiled parts compiled: on a new installation this takes longer than anybody waits at a question."""
    target = {"curve_percent": 0.2, "step_percent": 0.2}
    adaptive_outlook(lambda *_: None, target, 6.0, 100.0, largest_us=300.0, max_torque_nm=15.0, pulse_rate_hz=40.0)


def known(models: Sequence[str]) -> Any:
    """Return the last model and how much the person changes between sessions, `Earlier`; None of a new person.

    A model that cannot be read here is left out. A last model that cannot be read, or that is of another kind than the
    adaptive test fits, is no help, and none is taken in its place.
    """
    from stimrig.identify.estimation.earlier import Earlier, learn_change

    read, last = [], None
    for text in models:
        last = None
        with suppress(identify.IdentifyError):
            last = model_of(text)
            read.append(last)
    with suppress(identify.IdentifyError):
        return None if last is None else Earlier(last, learn_change(read))
    return None


@lru_cache(maxsize=32)
def model_of(text: str) -> identify.Model:
    """Read a model. It is kept, so that a test begins at once with those that its outlook has read."""
    return identify.Model.from_json(text)


def adaptive_begin(
    progress: Progress, target: dict[str, float], models: Sequence[str] = (), **limits: Any
) -> dict[str, Any]:
    """Begin a test within the limits that `Running` has, and forget the one before."""
    from stimrig.identify.experiments.knowledge import Target

    progress(0.5, "beginning")
    _running.clear()
    _running.append(Running(Target(**target), known(models), **limits))
    return {}


def adaptive_advise(progress: Progress, **news: Any) -> dict[str, Any]:
    """Decide what to play after everything that is laid; see `Running.advise`."""
    progress(0.1, "deciding")
    if not _running:
        raise RuntimeError("the worker process was started again during the test")
    return json_value(_running[0].advise(**news))


@dataclass(eq=False)
class Running:
    """One adaptive test, as far as it was measured."""

    target: Any
    earlier: Any
    playable_s: float
    max_torque_time_nm_s: float
    largest_us: float
    pulse_rate_hz: float
    samples: bytes = b""
    outcomes: dict[str, list[Any]] = field(default_factory=dict)
    decision: Any = None

    def advise(
        self,
        samples: bytes,
        zero_s: float,
        outcomes: Mapping[str, list[Any]],
        laid_us: list[float],
        segments: Segments,
        torque_time_nm_s: float,
        measured_s: float,
    ) -> dict[str, Any]:
        """Return the decision, and where the curves are known least.

        `samples`, `outcomes`: those that are new, as the rig sends both; `zero_s`: begin of the test on the clock of
        the samples; `laid_us`, `segments`: widths of all pulses that are laid, and their segments; `torque_time_nm_s`,
        `measured_s`: what was measured, and until when.
        """
        from stimrig.identify.experiments.adaptive import AdaptiveGoal, decide

        self.samples += samples
        for name, column in outcomes.items():
            self.outcomes.setdefault(name, []).extend(column)
        rows, rate_hz = np.frombuffer(self.samples, SAMPLE), self.pulse_rate_hz
        record = live_record(rows, zero_s, self.outcomes, laid_us, segments, rate_hz)
        played_us = np.array(laid_us, float)
        played_us[self.outcomes["index"]] = self.outcomes["pulse_width_us"]
        committed_nm_s = self._expected_nm_s(laid_us[round(measured_s * rate_hz) :])
        left_s = max(0.0, self.playable_s - len(laid_us) / rate_hz)
        left_nm_s = max(0.0, self.max_torque_time_nm_s - torque_time_nm_s - committed_nm_s)
        limits = AdaptiveGoal(self.target, left_s, left_nm_s, self.largest_us, rate_hz, self.earlier)
        decision = decide(record, played_us, limits, self.decision)
        self.decision = decision if decision.short is not None else self.decision
        document = decision.to_dict()
        for number, segment in enumerate(document["segments"], start=len(segments) + 1):  # not all laid are measured
            segment["name"] = f"{segment['name']} {number}"
        if (knowledge := decision.knowledge) is not None:
            curve, step = knowledge.curve, knowledge.step
            document["knowledge"] = rounded(document["knowledge"])
            document["least_known"] = {
                "pulse_width_us": round(float(curve.at[int(np.argmax(curve.half))]), 1),
                "time_s": round(float(step.at[int(np.argmax(step.half))]), 3),
            }
        return document

    def _expected_nm_s(self, widths_us: list[float]) -> float:
        """Estimate the torque-time of pulses that are not yet measured by the mean curve; 0 before there is one."""
        if self.decision is None or self.decision.knowledge is None:
            return 0.0
        knowledge = self.decision.knowledge
        shares = np.interp(widths_us, knowledge.curve.at, knowledge.curve.value)
        return float(np.sum(shares)) * knowledge.plateau_nm / self.pulse_rate_hz


def rounded(document: dict[str, Any]) -> dict[str, Any]:
    """Round all numbers of a document to what a page shows."""
    return json.loads(json.dumps(json_value(document)), parse_float=lambda text: round(float(text), DIGITS))


_running: list[Running] = []
"""The test that runs; at most one."""

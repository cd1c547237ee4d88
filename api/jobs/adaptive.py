"""Verbs of adaptive tests: what a test can reach, and what to play next in the one that runs.

That test stays in this process between two jobs: a job brings only the samples that are new.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.record_files import Progress
from stimrig.identify.json_text import json_value

NEW_PERSON_SHARE = 1 / 3
"""Of the torque that stops a test: the guess of a new person's torque at the largest width."""
DIGITS = 4
BINS = 5
"""Means for each pulse interval, where a load cell gives at least twice as many samples: the delay of a sample's way to
the host, some milliseconds that only a sealed recording corrects, is then within the one sample that the fit allows."""
SAMPLE = np.dtype(
    [("host_time_s", "<f8"), ("stamp_s", "<f8"), ("torque_nm", "<f8"), ("counter", "<i8"), ("sync", "u1")]
)
"""As `stimrig.rig.messages.TORQUE_ROW`."""
Segments = Sequence[tuple[str, int, int]]
"""Name, first pulse and end of each."""


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
    from stimrig.identify.experiments.adaptive import Asked, decide, reach
    from stimrig.identify.experiments.knowledge import Target

    progress(0.1, "playing the test on a simulated muscle")
    limits = Asked(Target(**target), playable_s, max_torque_time_nm_s, largest_us, pulse_rate_hz, known(models))
    opening = decide(None, (), limits)
    widths = [width for segment in opening.segments for width in segment.settings["pulse_width_us"]]
    outlook = reach(limits, NEW_PERSON_SHARE * max_torque_nm)
    return json_value({"opening_us": widths, "reach": asdict(outlook), "known": limits.earlier is not None})


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

        Parameters
        ----------
        samples, outcomes
            Samples that are new, and what became of pulses since, as the rig sends both.
        zero_s
            Begin of the test on the clock of the samples, s.
        laid_us, segments
            Widths of all pulses that are laid, µs, and their segments.
        torque_time_nm_s, measured_s
            Torque-time that was measured, N·m·s, and until when, s.
        """
        from stimrig.identify.experiments.adaptive import Asked, decide

        self.samples += samples
        for name, column in outcomes.items():
            self.outcomes.setdefault(name, []).extend(column)
        rows = np.frombuffer(self.samples, SAMPLE)
        record = record_of(rows, zero_s, self.outcomes, laid_us, segments, self.pulse_rate_hz)
        played_us = np.array(laid_us, float)
        played_us[self.outcomes["index"]] = self.outcomes["pulse_width_us"]
        committed_nm_s = self._expected_nm_s(laid_us[round(measured_s * self.pulse_rate_hz) :])
        left_s = max(0.0, self.playable_s - len(laid_us) / self.pulse_rate_hz)
        left_nm_s = max(0.0, self.max_torque_time_nm_s - torque_time_nm_s - committed_nm_s)
        limits = Asked(self.target, left_s, left_nm_s, self.largest_us, self.pulse_rate_hz, self.earlier)
        decision = decide(record, played_us, limits, self.decision)
        self.decision = decision if decision.short is not None else self.decision
        document = decision.to_dict()
        for number, segment in enumerate(document["segments"], start=len(segments) + 1):  # not all laid are measured
            segment["name"] = f"{segment['name'].rpartition(' ')[0]} {number}"
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


def rounded(value: Any) -> Any:
    """Round all numbers in a document to what a page shows."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return round(value, DIGITS) if isinstance(value, float) else value


def record_of(
    samples: Any, zero_s: float, outcomes: Mapping[str, Any], laid_us: list[float], segments: Segments, rate_hz: float
) -> Any:
    """Return the record of what was measured since the first pulse, for `decide`; None where there is nothing yet.

    Pulses are those that were felt, by the same rules as in a sealed recording.
    """
    from stimrig.identify.records.pulse_times import in_force, locate_pulses
    from stimrig.identify.records.record import Record

    if samples.size < 2:
        return None
    time_s = sample_times(samples["host_time_s"] - zero_s, samples["counter"])
    whole_s = min(np.floor(time_s[-1] * rate_hz), len(laid_us)) / rate_hz  # of an interval's begin a mean is noisy
    inside = np.isfinite(samples["torque_nm"]) & (time_s >= 0) & (time_s < whole_s - 1e-9)
    if not inside.any():
        return None
    time_s, torque, sync = time_s[inside], samples["torque_nm"][inside], samples["sync"][inside]
    pulse_count = int(time_s[-1] * rate_hz) + 1
    pulses, doubted = locate_pulses(_sent(outcomes, laid_us[:pulse_count], rate_hz), time_s, sync)
    even_s, torque = means(time_s, torque, BINS * rate_hz)
    width_us, late_s = in_force(pulses, even_s, rate_hz)
    code = np.searchsorted([start for _, start, _ in segments], even_s * rate_hz + 1e-9, side="right") - 1
    return Record.from_arrays(
        even_s, width_us, torque, code, segment_names=[name for name, _, _ in segments], late_s=late_s,
        doubted=np.interp(even_s, time_s, doubted) > 0, pulses=pulses, pulse_rate_hz=rate_hz,
    )  # fmt: skip


def _sent(outcomes: Mapping[str, Any], laid_us: list[float], rate_hz: float) -> Any:
    """Return what is known of each pulse; one whose outcome is not known yet is on its way."""
    from stimrig.identify.records.pulse_times import ON_ITS_WAY, RESTS, Sent

    widths_us = np.array(laid_us, float)
    written_s, acknowledged_s = np.full(widths_us.size, np.nan), np.full(widths_us.size, np.nan)
    status = np.where(widths_us > 0, ON_ITS_WAY, RESTS)
    index = np.array(outcomes["index"], int)
    is_laid = index < widths_us.size
    columns = {"pulse_width_us": widths_us, "written_time_s": written_s, "acknowledged_time_s": acknowledged_s}
    for name, column in {**columns, "status": status}.items():
        column[index[is_laid]] = np.array(outcomes[name], float)[is_laid]
    return Sent(np.arange(widths_us.size) / rate_hz, widths_us, written_s, acknowledged_s, status, 1.0 / rate_hz)


def means(time_s: Any, torque_nm: Any, rate_hz: float) -> tuple[Any, Any]:
    """Average over even bins, each at its middle; return the samples where there are not two for each bin."""
    if time_s.size < 2 * rate_hz * (time_s[-1] - time_s[0]):
        return time_s, torque_nm
    number = np.floor(time_s * rate_hz + 1e-9).astype(int)
    count = np.bincount(number)
    filled = np.flatnonzero(count)
    return (filled + 0.5) / rate_hz, (np.bincount(number, torque_nm)[filled] / count[filled])


def sample_times(host_s: Any, counter: Any) -> Any:
    """Estimate when the samples were taken: evenly by the cell's counter, on the line below all arrivals.

    Samples arrive late and never early, after a pause of the computer all of it at once: so no arrival lies below the
    line. Of such lines it is the highest one in the record's middle, an edge of the arrivals' lower convex hull.
    """
    number = np.array(counter, float)
    if number.min() < 0:  # the cell has none
        number = np.arange(host_s.size, dtype=float)
    number -= number[0]
    hull: list[Any] = []
    latest = np.r_[np.diff(host_s) > 0, True]  # of those that came at once
    for point in np.column_stack([number, host_s])[latest].tolist():
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    corners = np.array(hull)
    after = int(np.clip(np.searchsorted(corners[:, 0], number.mean()), 1, len(corners) - 1))
    (start, start_s), (end, end_s) = corners[after - 1], corners[after]
    return start_s + (end_s - start_s) / (end - start) * (number - start)


def _turn(first: Any, second: Any, third: Any) -> float:
    """Return a value above 0 where the way from the first point to the third turns upwards at the second."""
    return (second[0] - first[0]) * (third[1] - first[1]) - (second[1] - first[1]) * (third[0] - first[0])


_running: list[Running] = []
"""The test that runs; at most one."""

"""The next experiment: the shortest test that tells apart what a record cannot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.identify import experiments
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.records.record import Record
from stimrig.identify.results import Diagnosis, Result
from stimrig.identify.summary import Sheet


@dataclass(frozen=True, repr=False, eq=False)
class Experiment(Result):
    """A test that tells rival effects apart.

    Parameters
    ----------
    rivals : tuple of str
        Ids of the effects.
    segments : tuple of dict
        The test: `name`, `sequence` and `settings` of each segment, as `POST /v1/tests` takes them.
    duration_s : float
        Duration, s.
    dose : dict
        `pulses`, `pulse_width_sum_us` and `torque_time_nm_s`.
    expected_log_evidence : float
        How clearly the test is expected to decide.
    decides : bool
        Whether that is enough.
    text : str
        The test in one sentence.
    """

    rivals: tuple[str, ...]
    segments: tuple[Mapping[str, Any], ...]
    duration_s: float
    dose: Mapping[str, float]
    expected_log_evidence: float
    decides: bool
    text: str

    def _sheet(self) -> Sheet:
        rows = [("test", self.text), ("pulses", f"{self.dose['pulses']:.0f}")]
        for segment in self.segments:
            settings = ", ".join(f"{key} {_short(value)}" for key, value in segment["settings"].items())
            rows.append((str(segment["name"]), f"{segment['sequence']}: {settings}"))
        return Sheet(f"Next experiment: {' or '.join(self.rivals)}, {self.duration_s:.0f} s", tuple(rows))


def next_experiment(about: Record | Diagnosis, rivals: Sequence[str] = ()) -> Experiment | None:
    """The shortest safe test that tells rival effects apart.

    Parameters
    ----------
    about : Record or Diagnosis
        A record on which the rivals cannot be told apart, or what `diagnose` found on one.
    rivals : sequence of str
        Ids of effects to tell apart on a record; one alone is told apart from no effect. Without any, the record is
        diagnosed first: its most probable effect that has rivals, and the first of these.

    Returns
    -------
    Experiment or None
        None if nothing is left to be told apart.

    Raises
    ------
    BadRequest
        An effect is not in the library.
    """
    if not rivals:
        diagnosis = about if isinstance(about, Diagnosis) else diagnose(about)
        return planned(diagnosis.missing)
    if isinstance(about, Diagnosis):
        raise TypeError("rivals are told apart on a record: next_experiment(record, rivals)")
    return _experiment(rivals, experiments.next_experiment(about, rivals))


def planned(missing: Sequence[Mapping[str, Any]]) -> Experiment | None:
    """The experiment of the first effect with rivals among those that a diagnosis found missing; None without any."""
    for row in missing:
        if row["confused_with"] and row["next_experiment_plan"]:
            return _experiment([row["effect"], row["confused_with"][0]], row["next_experiment_plan"])
    return None


def _experiment(rivals: Sequence[str], plan: Mapping[str, Any]) -> Experiment:
    told = {name: plan[name] for name in ("duration_s", "dose", "expected_log_evidence", "decides", "text")}
    return Experiment(rivals=tuple(rivals), segments=tuple(plan["segments"]), **told)


def _short(value: Any) -> str:
    return f"{len(value)} values" if isinstance(value, list | tuple) else str(value)

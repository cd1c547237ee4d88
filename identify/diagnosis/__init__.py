"""What is missing from the model of a record: candidates, evidence, verdict, words."""

from __future__ import annotations

from identify.diagnosis.analysis import Analysis, analyse
from identify.diagnosis.candidates import Progress
from identify.diagnosis.report import report
from identify.diagnosis.verdict import Verdict, judge
from identify.records.record import Record
from identify.results import Diagnosis


def diagnose(record: Record, progress: Progress | None = None) -> Diagnosis:
    """What is missing from a Hammerstein model of this record.

    Parameters
    ----------
    record : Record
        Pulse widths and torque; rows of `validate` are never used to fit or to choose.
    progress : callable or None
        Called with a share of 0 to 1 and a line of text; may raise `Cancelled`.

    Returns
    -------
    Diagnosis
        The verdict, what is missing (most probable first), and the evidence for it.

    Raises
    ------
    BadRecord
        Too short, or sampled too slowly.
    """
    work = analyse(record, progress)
    result = report(work, judge(work))
    if progress is not None:
        progress(1.0, "done")
    return result


__all__ = ["Analysis", "Verdict", "analyse", "diagnose", "judge"]

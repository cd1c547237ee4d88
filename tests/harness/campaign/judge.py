"""What came of an injection, and what of it is wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from rig import archive
from rig.errors import RecordingError
from tests.harness.campaign.cases import CASES

BOUND_MS = 50.0
SHORTEST_MS = 8.0
"""Of the intervals at the electrode, in emulated time: written down here again on purpose."""


@dataclass
class Verdict:
    """One injection. Times in real ms; None where there was nothing to measure."""

    fault: str
    phase: str
    seed: int
    outcome: str = ""
    reason: str = ""
    last_pulse_ms: float | None = None
    after_known_ms: float | None = None
    confirmed: bool | None = None
    evidence: str = ""
    felt: int = 0
    kept: int = 0
    shortest_ms: float | None = None
    acknowledged: int = 0
    tail_ms: float | None = None
    opens: bool | None = None
    rearmed: bool | None = None
    wrong: list[str] = field(default_factory=list)
    failed: str = ""
    """Why the campaign itself could not judge it; it is then no injection."""


def judge_file(verdict: Verdict, path: str | None) -> dict[str, Any] | None:
    """Does the recording open, is it whole, does it hold every pulse that was felt, and no ack of one that was not?"""
    if path is None:
        verdict.opens = False
        verdict.wrong.append("no recording")
        return None
    try:
        with h5py.File(path) as file:
            stated = file.attrs["content_sha256"]
            status, written_s = file["pulses/status"][:], file["pulses/written_time_s"][:]
            host_s = file["torque/host_time_s"][:]
        verdict.opens = archive.verify(Path(path)) == stated
    except (OSError, KeyError, RecordingError) as error:
        verdict.opens = False
        verdict.wrong.append(f"file: {error}")
        return None
    verdict.kept = int(np.sum(np.isin(status, (0, 4, 5))))
    verdict.acknowledged = int(np.sum(status == 0))
    if verdict.acknowledged > verdict.felt:
        verdict.wrong.append(f"{verdict.acknowledged} pulses acknowledged in the file, {verdict.felt} felt")
    if verdict.felt > verdict.kept:
        verdict.wrong.append(f"{verdict.felt} pulses felt, {verdict.kept} in the file")
    return {"written_s": written_s[np.isfinite(written_s)], "host_s": host_s}


def judge_times(verdict: Verdict, felt_s: list[float], injected_s: float) -> None:
    """How long after the fault, and after the host could know of it, was the last pulse felt?"""
    case = CASES[verdict.fault]
    must = case.must if verdict.phase not in ("rest", "sealing") else (case.resting or case.must)
    if not felt_s or verdict.phase == "sealing" or must == "go on" or verdict.outcome == "completed":
        return
    felt_s = felt_s[: len(felt_s) - case.may_follow] or felt_s
    verdict.last_pulse_ms = 1e3 * (felt_s[-1] - injected_s)
    hidden_s = case.hidden_s
    if verdict.fault in ("no_ack", "late_ack", "corrupt_answers", "corrupt_commands"):
        later = [t for t in felt_s if t >= injected_s]  # an ack is missing from the first pulse on that has none
        hidden_s += max(0.0, later[0] - injected_s) if later else 0.0
    verdict.after_known_ms = verdict.last_pulse_ms - 1e3 * hidden_s
    if must == "stop" and verdict.after_known_ms > BOUND_MS:
        verdict.wrong.append(f"a pulse {verdict.after_known_ms:.0f} ms after the fault could be known")


def judge_intervals(verdict: Verdict, felt_s: list[float]) -> None:
    """Whatever the fault: no two pulses closer than the limit."""
    if len(felt_s) < 2:
        return
    verdict.shortest_ms = 1e3 * float(np.min(np.diff(felt_s)))
    if verdict.shortest_ms < SHORTEST_MS:
        verdict.wrong.append(f"two pulses felt {verdict.shortest_ms:.2f} ms apart")


def judge_outcome(verdict: Verdict) -> None:
    """Stopped where it must, went on where it must, and said why."""
    case = CASES[verdict.fault]
    must = case.must
    if verdict.phase == "rest":
        must = case.resting or case.must
    if verdict.phase in ("sealing", "arming"):
        must = "either" if must == "stop" or verdict.phase == "sealing" else must
    if must == "stop" and verdict.outcome == "completed":
        verdict.wrong.append("it went on")
    if must == "go on" and verdict.outcome != "completed":
        verdict.wrong.append(f"it stopped: {verdict.reason}")
    if verdict.outcome != "completed" and not verdict.reason:
        verdict.wrong.append("no reason told")

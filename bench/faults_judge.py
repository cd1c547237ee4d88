"""What came of an injection, and the table of all of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bench.faults_cases import CASES, PHASES
from rig import archive
from rig.errors import RecordingError

BOUND_MS = 50.0


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
    tail_ms: float | None = None
    opens: bool | None = None
    rearmed: bool | None = None
    wrong: list[str] = field(default_factory=list)


def judge_file(verdict: Verdict, path: str | None) -> dict[str, Any] | None:
    """Does the recording open, is it whole, and does it hold every pulse that was felt?"""
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
    if verdict.felt > verdict.kept:
        verdict.wrong.append(f"{verdict.felt} pulses felt, {verdict.kept} in the file")
    return {"written_s": written_s[np.isfinite(written_s)], "host_s": host_s}


def judge_times(verdict: Verdict, felt_s: list[float], injected_s: float) -> None:
    """How long after the fault, and after the host could know of it, was the last pulse felt?"""
    case = CASES[verdict.fault]
    must = case.must if verdict.phase not in ("rest", "sealing") else (case.resting or case.must)
    if not felt_s or verdict.phase == "sealing" or must == "go on" or verdict.outcome == "completed":
        return
    verdict.last_pulse_ms = 1e3 * (felt_s[-1] - injected_s)
    hidden_s = case.hidden_s
    if verdict.fault in ("no_ack", "late_ack", "corrupt_answers", "corrupt_commands"):
        later = [t for t in felt_s if t >= injected_s]  # an ack is missing from the first pulse on that has none
        hidden_s += max(0.0, later[0] - injected_s) if later else 0.0
    verdict.after_known_ms = verdict.last_pulse_ms - 1e3 * hidden_s
    if must == "stop" and verdict.after_known_ms > BOUND_MS:
        verdict.wrong.append(f"a pulse {verdict.after_known_ms:.0f} ms after the fault could be known")


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


def _spread(values: list[float]) -> str:
    return "" if not values else f"{np.median(values):.0f} / {max(values):.0f}"


def _share(flags: list[bool]) -> str:
    return "" if not flags else f"{sum(flags)}/{len(flags)}"


def table(found: list[Verdict], conditions: str) -> str:
    """docs/faults.md."""
    wrong = [v for v in found if v.wrong]
    stops = [v.after_known_ms for v in found if v.after_known_ms is not None and CASES[v.fault].must == "stop"]
    late = sum(ms > BOUND_MS for ms in stops)
    files = [v.opens for v in found if v.opens is not None]
    ended = [v for v in found if v.outcome != "completed"]
    confirmed = [v.confirmed for v in ended if v.confirmed is not None]
    lines = [
        "# Faults",
        "",
        "Written by `python -m bench.faults` (`make faults`); a short version runs in the tests. " + conditions,
        "",
        f"- pulses later than {BOUND_MS:.0f} ms after the host could know of the fault: {late} of {len(stops)} stopped "
        f"tests (worst {max(stops, default=0):.0f} ms)",
        f"- felt pulses that no file holds: {sum(max(0, v.felt - v.kept) for v in found if v.opens)}",
        f"- files that open and match their hash: {sum(map(bool, files))} of {len(files)}",
        f"- tests that ended early and were told a reason: {sum(bool(v.reason) for v in ended)} of {len(ended)}",
        f"- stops confirmed by device and torque where both could still answer: {_share([bool(c) for c in confirmed])}",
        f"- re-armed after the fault was mended: {_share([bool(v.rearmed) for v in found if v.rearmed is not None])}",
        f"- injections with anything wrong: {len(wrong)}",
        "",
        '"Known" is when something that the host receives differs, or when nothing came for as long as it waits: '
        "100 ms for torque and acks, 0.5 s for a value that stands still, 3 s for the disk. Times are real ms, "
        'median / worst; a time below zero means that no pulse came after the fault. "Ended" counts tests that did '
        "not go on to their end. Where a fault cannot be seen in a phase (an electrode in a rest), going on is right.",
        "",
        "| fault | phase | n | ended | last pulse after fault, ms | after it was known, ms | confirmed | file opens "
        "| felt / in file | re-armed | what was told (one of them) |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    key = lambda v: (list(CASES).index(v.fault), PHASES.index(v.phase))  # noqa: E731
    for (fault, phase), group in groupby(sorted(found, key=key), key=key):
        these = list(group)
        reasons = [v.reason for v in these if v.reason] or [""]
        lines.append(
            f"| {list(CASES)[fault]} | {PHASES[phase]} | {len(these)} "
            f"| {sum(v.outcome != 'completed' for v in these)} "
            f"| {_spread([v.last_pulse_ms for v in these if v.last_pulse_ms is not None])} "
            f"| {_spread([v.after_known_ms for v in these if v.after_known_ms is not None])} "
            f"| {_share([bool(v.confirmed) for v in these if v.confirmed is not None])} "
            f"| {_share([bool(v.opens) for v in these if v.opens is not None])} "
            f"| {sum(v.felt for v in these)} / {sum(v.kept for v in these)} "
            f"| {_share([bool(v.rearmed) for v in these if v.rearmed is not None])} "
            f"| {_tidy(reasons[0])} |"
        )
    if wrong:
        lines += ["", "## What went wrong", ""]
        lines += [f"- {v.fault}, {v.phase}, seed {v.seed}: {'; '.join(map(_tidy, v.wrong))}" for v in wrong]
    return "\n".join(lines) + "\n"


def _tidy(text: str) -> str:
    """One cell of a table, without this machine's paths."""
    words = ["…/" + word.rsplit("/", 1)[1] if word.count("/") > 1 else word for word in text.split()]
    return " ".join(words).replace("|", "/")[:150]

"""The table of a fault campaign, for docs/results/faults.md."""

from __future__ import annotations

from collections import Counter
from itertools import groupby

import numpy as np

from tests.harness.campaign.cases import CASES, PHASES
from tests.harness.campaign.judge import BOUND_MS, SHORTEST_MS, Verdict

HEAD = (
    "| fault | phase | n | ended | last pulse after fault, ms | after it was known, ms | confirmed | file opens "
    "| felt / in file | re-armed | what was told (one of them) |"
)
KNOWN = (
    '"Known" is when something that the host receives differs, or when nothing came for as long as it waits: 100 ms '
    "for torque, angle and acks, 0.5 s for a value that stands still, 3 s for the disk, 80 ms until a full disk's last "
    "page is full. Times are real ms, median / worst; a time below zero means that no pulse came after the fault. "
    '"Ended" counts tests that did not go on to their end. Where a fault cannot be seen in a phase (an electrode in a '
    "rest), "
    "going on is right. A stop is not called confirmed where the stimulator does not answer, where no torque comes, or "
    "where the fault itself holds the torque up: that is what it is to say then."
)


def table(judged: list[Verdict], conditions: str) -> str:
    """In Markdown: what all of them say together, then a row for each fault in each phase."""
    found = [verdict for verdict in judged if not verdict.failed]
    lines = ["`python -m bench.faults` (`make faults`); a short version runs in the tests. " + conditions, ""]
    lines += [*_together(found), "", KNOWN, "", HEAD, "|" + "---|" * 11]
    key = lambda v: (list(CASES).index(v.fault), PHASES.index(v.phase))  # noqa: E731
    for (fault, phase), group in groupby(sorted(found, key=key), key=key):
        lines.append(_row(list(CASES)[fault], PHASES[phase], list(group)))
    wrong = [v for v in found if v.wrong]
    if wrong:
        lines += ["", "Injections with anything wrong:", ""]
        lines += [f"- {v.fault}, {v.phase}, seed {v.seed}: {'; '.join(map(_tidy, v.wrong))}" for v in wrong]
    failed = [v for v in judged if v.failed]
    if failed:
        lines += ["", "Not judged, by a failing of the campaign itself, and not counted above:", ""]
        lines += [f"- {v.fault}, {v.phase}, seed {v.seed}: {_tidy(v.failed)}" for v in failed]
    return "\n".join(lines) + "\n"


def _together(found: list[Verdict]) -> list[str]:
    stops = [v.after_known_ms for v in found if v.after_known_ms is not None and CASES[v.fault].must == "stop"]
    late = sum(ms > BOUND_MS for ms in stops)
    files = [v.opens for v in found if v.opens is not None]
    ended = [v for v in found if v.outcome != "completed"]
    spread = (
        f"median {np.median(stops):.0f}, p99 {np.percentile(stops, 99):.0f}, worst {max(stops):.0f} ms" if stops else ""
    )
    why = Counter(_unconfirmed(v.evidence) for v in ended if v.confirmed is False)
    reasons = "; not confirmed: " + ", ".join(f"{n} {reason}" for reason, n in why.most_common()) if why else ""
    apart = [v.shortest_ms for v in found if v.shortest_ms is not None]
    tails = [v.tail_ms for v in found if v.tail_ms is not None]
    return [
        f"- pulses later than {BOUND_MS:.0f} ms after the host could know of the fault: {late} of {len(stops)} stopped "
        f"tests ({spread})",
        f"- tests with two pulses felt less than {SHORTEST_MS:g} ms apart: {sum(ms < SHORTEST_MS for ms in apart)} of "
        f"{len(apart)} (shortest {min(apart, default=float('nan')):.1f} ms)",
        f"- felt pulses that no file holds: {sum(max(0, v.felt - v.kept) for v in found if v.opens)} of "
        f"{sum(v.felt for v in found)}; acknowledged in a file and not felt: "
        f"{sum(max(0, v.acknowledged - v.felt) for v in found if v.opens)}",
        f"- torque before the death of the host that its file does not hold: at most {max(tails, default=0):.0f} ms, "
        f"{len(tails)} deaths",
        f"- files that open and match their hash: {sum(map(bool, files))} of {len(files)}",
        f"- tests that ended early and were told a reason: {sum(bool(v.reason) for v in ended)} of {len(ended)}",
        f"- stops confirmed by device and torque: {_share([v.confirmed for v in ended if v.confirmed is not None])}"
        + reasons,
        f"- re-armed after the fault was removed: {_share([v.rearmed for v in found if v.rearmed is not None])}",
        f"- injections with anything wrong: {sum(bool(v.wrong) for v in found)} of {len(found)}",
    ]


def _unconfirmed(evidence: str) -> str:
    if "did not answer" in evidence:
        return "as the stimulator did not answer"
    if "no torque" in evidence:
        return "as no torque came"
    if "torque is still" in evidence:
        return "as the torque stayed up"
    return "as the stimulator did not say that it cannot stimulate"


def _row(fault: str, phase: str, these: list[Verdict]) -> str:
    reasons = [v.reason for v in these if v.reason] or [""]
    return (
        f"| {fault} | {phase} | {len(these)} | {sum(v.outcome != 'completed' for v in these)} "
        f"| {_spread([v.last_pulse_ms for v in these if v.last_pulse_ms is not None])} "
        f"| {_spread([v.after_known_ms for v in these if v.after_known_ms is not None])} "
        f"| {_share([v.confirmed for v in these if v.confirmed is not None])} "
        f"| {_share([v.opens for v in these if v.opens is not None])} "
        f"| {sum(v.felt for v in these)} / {sum(v.kept for v in these)} "
        f"| {_share([v.rearmed for v in these if v.rearmed is not None])} "
        f"| {_tidy(reasons[0])} |"
    )


def _spread(values: list[float]) -> str:
    return "" if not values else f"{np.median(values):.0f} / {max(values):.0f}"


def _share(flags: list[bool]) -> str:
    return "" if not flags else f"{sum(flags)}/{len(flags)}"


def _tidy(text: str) -> str:
    """One cell of a table, without this machine's paths."""
    words = ["…/" + word.rsplit("/", 1)[1] if word.count("/") > 1 else word for word in text.split()]
    return " ".join(words).replace("|", "/")[:150]

"""The report of a test, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stimrig.api.clinical_words import label_rows, words
from stimrig.api.models.changes import dose_words
from stimrig.identify.summary import Sheet, quantity


def report_test(test: Mapping[str, Any]) -> str:
    """Write what was played and recorded, what is in doubt, and how soon the model was there."""
    summary, planned, carried = test["summary"], test.get("planned") or {}, (test.get("fit") or {}).get("carried")
    late, aligned = summary.get("lateness_ms") or {}, summary.get("alignment") or {}
    latest = ", ".join(f"{name} {quantity(late.get(name), 'ms')}" for name in ("median", "p99", "max"))
    torque_time = f", {quantity(planned['torque_time_nms'], 'N·m·s')} planned" if planned.get("torque_time_nms") else ""
    rows = [
        *label_rows(test),
        ("dose", f"{dose_words(summary.get('charge_uc'))} a phase over the test{torque_time}"),
        (
            "torque",
            f"{summary.get('samples')} samples at {quantity(summary.get('sample_rate_hz'), 'Hz')}, lost "
            f"{summary.get('lost_samples')}, peak {quantity(summary.get('torque_peak_nm'), 'N·m')}",
        ),
        ("pulses", f"{summary.get('pulses')}, dropped {summary.get('dropped_pulses')}; written late by {latest}"),
        ("clocks", f"aligned by {aligned.get('method')}, error {quantity(aligned.get('error_ms'), 'ms')}"),
        *(("in doubt", text) for text in summary.get("warnings") or []),
        *(("note", text) for text in summary.get("notes") or []),
        *_adaptive_rows(test.get("adaptive")),
        *([("carried over", f"the {carried['offered']} structure is offered: {carried['reason']}")] if carried else []),
        ("served", f"{quantity(summary.get('last_sample_to_model_s'), 's')} from the last sample to the stored model"),
    ]
    duration = quantity(summary.get("duration_s"), "s")
    return Sheet(f"Test {test['id']} of {test['participant']}, {duration}", tuple(rows)).text()


def _adaptive_rows(adaptive: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Write why a test that stops itself ended, and what it reached; nothing of another one."""
    if not adaptive:
        return []
    known, target = adaptive["knowledge"] or {}, adaptive["target"] or {}
    reached = ", ".join(
        f"{title} within {quantity(known.get(name), '%')} (asked: {quantity(target.get(name), '%')})"
        for name, title in (("curve_percent", "curve"), ("step_percent", "step response"))
    )
    used, bound = (quantity(adaptive[name], "N·m·s") for name in ("torque_time_nm_s", "max_torque_time_nm_s"))
    rows = [("ended", f"{words(adaptive['ended'], 'end')}; {used} of at most {bound}"), ("known", reached)]
    return [*rows, *([("in doubt", adaptive["problem"])] if adaptive["problem"] else [])]

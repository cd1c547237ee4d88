"""Reports of a model and of a test, as lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stimrig.api.cli.terminal import labelled, number, percent


def model_report(document: dict[str, Any]) -> list[str]:
    """Write what a person reads off a MODEL.json."""
    from stimrig.api.models import stored_model
    from stimrig.identify.summary import one_line

    fit, judged = stored_model.figures(document), stored_model.quality(document)
    dynamics, curve = stored_model.dynamics(document), stored_model.recruitment(document)
    effects = ", ".join(effect["id"] for effect in document.get("effects") or []) or "none"
    in_turn = "in turn, cross-validated: " if fit["held_out_by"] == "cross-validation" else ""
    lines = [
        f"model          {document['model_id']}  ({document['method']}, effects: {effects})",
        f"fit            {percent(fit['fit_percent'])}  (the noise allows {number(fit['ceiling_percent'])} %), "
        f"error {number(fit['rms_nm'], 4)} N·m, noise {number(fit['noise_sd_nm'], 4)} N·m",
        "held out       nothing"
        if fit["held_out_rms_nm"] is None
        else f"held out       {in_turn}fit {percent(fit['held_out_fit_percent'])}, "
        f"error {number(fit['held_out_rms_nm'], 4)} N·m",
        *repetition_lines(document.get("fit") or {}),
    ]
    if dynamics["time_constant_s"] is not None:
        lines.append(
            f"dynamics       Tω {number(dynamics['time_constant_s'], 4)} s, ζ {number(dynamics['damping'], 4)}, "
            f"delay {number(1000 * (dynamics['delay_s'] or 0), 1)} ms"
        )
    return [
        *lines,
        f"recruitment    threshold {number(curve['threshold_us'], 0)} µs (5 % of the rise), "
        f"plateau {number(curve['plateau_nm'])} N·m (95 % at {number(curve['saturation_us'], 0)} µs)",
        *labelled("chosen", [one_line(reason) for reason in (document.get("reasons") or [])[1:]]),
        f"quality        {judged['verdict']}: {judged['words']}",
        *labelled("", [f"also: {reason}" for reason in judged["reasons"][1:]]),
    ]


def repetition_lines(fit: Mapping[str, Any]) -> list[str]:
    """Write what repeats in the record, a line for each sentence."""
    from stimrig.identify.yardstick import repetition_sentences

    return labelled("repetition", repetition_sentences(fit))


def carried_lines(finding: Mapping[str, Any] | None) -> list[str]:
    """Write what a record said of the structure of an earlier model; nothing where none was carried over."""
    if not finding:
        return []
    needed = {True: "still needed", False: "no longer needed", None: "left out, undecided"}
    earlier = finding.get("from_model_id") or finding["carried_from"]
    head = f"from model {earlier}; offered: the {finding['offered']} structure"
    rows = [f"{needed[row['needed']]}: {row['effect']}. {row['reason']}" for row in finding["effects"]]
    return labelled("carried over", [head, finding["reason"], *rows])


def report_test(test: Mapping[str, Any], model: dict[str, Any] | None) -> list[str]:
    """Write the report of a test, and of its model where that is asked for."""
    from stimrig.api.clinical_words import label_rows
    from stimrig.api.models.changes import dose_words

    summary, planned = test["summary"], test.get("planned") or {}
    late, aligned = summary.get("lateness_ms") or {}, summary.get("alignment") or {}
    parts = planned.get("segments") or []
    segments = ", ".join(f"{part['name']} {part['end_s'] - part['start_s']:g} s" for part in parts)
    torque_time = planned.get("torque_time_nms")
    dose = f"{dose_words(summary.get('charge_uc'))} a phase over the test"
    if torque_time is not None:
        dose += f", {number(torque_time, 0)} N·m·s planned"
    return [
        f"test           {test['id']}  participant {test['participant']}, {number(summary.get('duration_s'), 1)} s",
        *(f"{title.lower():14} {text}" for title, text in label_rows(test)),
        # what is planned of a test that stops itself is not what was played
        *([] if test.get("adaptive") else [f"segments       {segments}"]),
        f"dose           {dose}",
        f"torque         {summary.get('samples')} samples at {number(summary.get('sample_rate_hz'), 1)} Hz, "
        f"lost {summary.get('lost_samples')}, peak {number(summary.get('torque_peak_nm'))} N·m",
        f"pulses         {summary.get('pulses')}, dropped {summary.get('dropped_pulses')}; written late by median "
        f"{number(late.get('median'), 3)}, p99 {number(late.get('p99'), 3)}, max {number(late.get('max'), 3)} ms",
        f"clocks         aligned by {aligned.get('method')}, error {number(aligned.get('error_ms'), 4)} ms",
        *(f"in doubt       {words}" for words in summary.get("warnings") or []),
        *(f"note           {words}" for words in summary.get("notes") or []),
        *_adaptive_lines(test.get("adaptive")),
        *(model_report(model) if model else []),
        *carried_lines((test.get("fit") or {}).get("carried")),
        f"served         {number(summary.get('last_sample_to_model_s'), 2)} s from the last sample to the stored model",
    ]


def _adaptive_lines(adaptive: Mapping[str, Any] | None) -> list[str]:
    """Write why a test that stops itself ended, and what it reached; nothing of another one."""
    from stimrig.api.clinical_words import words

    if not adaptive:
        return []
    known, target = adaptive["knowledge"] or {}, adaptive["target"] or {}
    reached = ", ".join(
        f"{title} within {number(known.get(name), 1)} % (asked: {number(target.get(name), 1)} %)"
        for name, title in (("curve_percent", "curve"), ("step_percent", "step response"))
    )
    used = f"{number(adaptive['torque_time_nm_s'], 1)} of at most {number(adaptive['max_torque_time_nm_s'], 1)} N·m·s"
    lines = [f"ended          {words(adaptive['ended'], 'end')}; {used}", f"known          {reached}"]
    return [*lines, *([f"in doubt       {adaptive['problem']}"] if adaptive["problem"] else [])]

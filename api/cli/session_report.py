"""A test through the REST client on the command line: its progress, and its report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

from stimrig.api.cli.errors import CommandError
from stimrig.api.cli.terminal import carried_lines, model_report, number
from stimrig.api.client.errors import Unreachable
from stimrig.api.client.rest import Client
from stimrig.api.clinical_words import label_rows, words
from stimrig.api.models.changes import dose_words
from stimrig.api.web.responses.rig import TestOut


def run_test(
    client: Client,
    participant: str,
    events: Callable[[], list[str]] = list,
    over: Callable[[], object] = list,
    **more: Any,
) -> TestOut:
    """Run a test, the default pre-session test unless `more` says otherwise, and show its progress.

    The participant is made unless it is there. `events` says which processes of the service have ended; one is enough
    to give up. `over` is called as soon as nothing of the test is played any more.

    Raises CommandError: a process has ended. Raises ServiceError: the test was refused, or did not complete.
    """
    show = Progress()

    def watch(test: TestOut) -> None:
        for event in events():
            raise CommandError(event)
        if test["state"] not in ("requested", "running"):
            over()
        show(test)

    client.ensure_participant(participant)
    try:
        return client.run_test(participant, watch, **more)
    except Unreachable as error:
        for event in events():
            raise CommandError(event) from error
        raise


class Progress:
    """A progress line: on a terminal in place, elsewhere a line a segment."""

    def __init__(self) -> None:
        self.terminal = sys.stderr.isatty()
        self.last = ""

    def __call__(self, document: TestOut) -> None:
        """Show where the test stands."""
        if document["state"] == "identifying":
            segment = (document.get("identification") or {}).get("text") or "identifying"
            words = f"identification: {segment}"
        elif (told := document.get("adaptive")) and document["state"] == "running":
            segment = told["problem"] or told["words"] or "a first look at the muscle"
            words = f"{document['elapsed_s']:4.1f} s  {number(told['torque_time_nm_s'], 1)} N·m·s  {segment}"
        else:
            segment = document.get("segment") or document["state"]
            words = f"{segment:10} {100 * document['progress']:3.0f} %  {document['time_left_s']:4.0f} s left"
        if self.terminal:
            words, end = (document["state"], "\n") if document["done"] else (words, "")
            print(f"\r\x1b[K  {words}", end=end, file=sys.stderr, flush=True)
        elif segment != self.last and not document["done"]:
            print(f"  {words}", file=sys.stderr, flush=True)
        self.last = segment


def adaptive_lines(told: Mapping[str, Any] | None) -> list[str]:
    """Why a test that stops itself ended, and what it reached; nothing of another one."""
    if not told:
        return []
    known, target = told["knowledge"] or {}, told["target"] or {}
    reached = ", ".join(
        f"{words} within {number(known.get(name), 1)} % (asked: {number(target.get(name), 1)} %)"
        for name, words in (("curve_percent", "curve"), ("step_percent", "step response"))
    )
    used = f"{number(told['torque_time_nm_s'], 1)} of at most {number(told['max_torque_time_nm_s'], 1)} N·m·s"
    lines = [f"ended          {words(told['ended'], 'end')}; {used}", f"known          {reached}"]
    return [*lines, *([f"in doubt       {told['problem']}"] if told["problem"] else [])]


def report_lines(test: Mapping[str, Any], model: dict[str, Any] | None) -> list[str]:
    """The report of a test, and of its model where that is asked for."""
    summary, planned = test["summary"], test.get("planned") or {}
    late, aligned = summary.get("lateness_ms") or {}, summary.get("alignment") or {}
    segments = ", ".join(
        f"{part['name']} {part['end_s'] - part['start_s']:g} s" for part in planned.get("segments") or []
    )
    torque_time = planned.get("torque_time_nms")
    dose = f"{dose_words(summary.get('charge_uc'))} a phase over the test"
    if torque_time is not None:
        dose += f", {number(torque_time, 0)} N·m·s planned"
    return [
        f"test           {test['id']}  participant {test['participant']}, {number(summary.get('duration_s'), 1)} s",
        *(f"{title.lower():14} {said}" for title, said in label_rows(test)),
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
        *adaptive_lines(test.get("adaptive")),
        *(model_report(model) if model else []),
        *carried_lines((test.get("fit") or {}).get("carried")),
        f"served         {number(summary.get('last_sample_to_model_s'), 2)} s from the last sample to the stored model",
    ]

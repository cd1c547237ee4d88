"""`stimrig test`: one pre-session test on the configured rig."""

from __future__ import annotations

import contextlib
import inspect
import os
import secrets
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from threading import Event
from typing import Annotated, Any

import typer

from stimrig import identify
from stimrig.api.cli import deciding
from stimrig.api.cli.commands.audit import check_service_output, settings_of
from stimrig.api.cli.errors import CommandError, InputError
from stimrig.api.cli.files import check_outputs, make_folder, write
from stimrig.api.cli.options import DataDir, Emulate, Json, RigFile, names, set_options
from stimrig.api.cli.reports import report_test
from stimrig.api.cli.stop_key import StopKey, at_rig, at_service
from stimrig.api.cli.supervisor import Services
from stimrig.api.cli.terminal import CLEAR_LINE, print_aside, report
from stimrig.api.client.errors import ServiceError, Unreachable
from stimrig.api.client.rest import Client
from stimrig.api.progress_bar import progress_bar
from stimrig.api.settings import Settings
from stimrig.api.web.responses.rig import TestOut
from stimrig.rig.messages import LABEL_TITLES, Labels

Events = Callable[[], list[str]]
"""Returns the events of the service's processes since the last call."""


def test(
    participant: Annotated[
        str | None,
        typer.Option(
            help="participant's code; default TEST, or with --decide whose the recording is", show_default=False
        ),
    ] = None,
    rig: RigFile = None,
    url: Annotated[str, typer.Option(help="a running service; default: one is started", envvar="STIMRIG_URL")] = "",
    data: DataDir = None,
    protocol: Annotated[
        str | None,
        typer.Option(help="another fixed test: paper, short, levels", show_default=False),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write the recording (HDF5) here")] = None,
    emulate: Emulate = "",
    adaptive: Annotated[bool, typer.Option("--adaptive", help="a test that stops itself once enough is known")] = False,
    target: Annotated[
        str, typer.Option(help="with --adaptive: half-widths of the bands of curve and step response, %", metavar="C,S")
    ] = "",
    max_time: Annotated[
        float | None, typer.Option(help="with --adaptive: longest test, s; default 50", show_default=False)
    ] = None,
    max_torque_time: Annotated[
        float | None,
        typer.Option(
            help="with --adaptive: largest torque-time, N·m·s; default 12 s at the torque that stops a test",
            show_default=False,
        ),
    ] = None,
    anyway: Annotated[bool, typer.Option("--anyway", help="play it although the target is out of reach")] = False,
    decide: Annotated[
        list[Path] | None,
        typer.Option(
            help="play the next experiment of this recording, and diagnose both together; again for each further one",
            metavar="DATA",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
    **labels: str | None,
) -> None:
    """One pre-session test: a fixed protocol is played, and the muscle is identified. Approves nothing.

    With --adaptive each segment is chosen by what is known so far, and the test stops once enough is known.
    """
    bounds = set_options(
        target=target_of(target), max_duration_s=max_time, max_torque_time_nm_s=max_torque_time, anyway=anyway or None
    )
    if bounds and not adaptive:
        raise InputError("--target, --max-time, --max-torque-time and --anyway go with --adaptive.")
    if (adaptive, protocol is not None, bool(decide)).count(True) > 1:
        raise InputError("--adaptive, --protocol and --decide are three kinds of test. Give one of them.")
    check = check_outputs if url else partial(check_service_output, settings_of(data))
    check_output = partial(check, decide or [], output, new_folder=output and output.parent)
    check_output()
    request = set_options(protocol=protocol, kind="adaptive" if adaptive else None, **bounds, **labels)
    if decide:
        request |= deciding.plan_experiment(decide, participant)
    over = Event()
    with service(url, rig, data, emulate, over) as (client, events):
        check_output()  # again: the service has made its files now
        if output is not None:
            make_folder(output.parent)
        code = request.pop("participant", participant or "TEST")
        result = play(client, code, request, events, over.set)
    recording = result.pop("recording")
    write(output, recording)  # first, so that a later error cannot lose the recording
    lines: list[object] = [report_test(result["test"])]
    if decide:
        explained, result["diagnosis"] = deciding.diagnose_together(decide, recording)
        lines += ["", "Both together", explained]
    elif not as_json:
        lines += ["", identify.Model.from_dict(result["model"])]
    report(result, as_json, *lines, f"recording: {output or result['test']['recording_url']}")


def _take_labels(verb: Any) -> None:
    """Make an option of each label that a person types, in the place of the verb's keywords."""
    *parameters, _labels = inspect.signature(verb, eval_str=True).parameters.values()
    for name in LABEL_TITLES:
        option = Annotated[str | None, typer.Option(help=Labels.model_fields[name].description, show_default=False)]
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=option))
        verb.__annotations__[name] = option
    verb.__signature__ = inspect.Signature(parameters)


_take_labels(test)


def target_of(text: str) -> dict[str, float] | None:
    """Read a target as it is typed: one number for both curves, or two. Raises InputError: it is none."""
    try:
        values = [float(part) for part in names(text)]
    except ValueError:
        values = [0.0] * 3
    if len(values) > 2:
        raise InputError(f"--target {text}: give one number, as 2, or two, as 2,3: % of the curve and step response.")
    return {"curve_percent": values[0], "step_percent": values[-1]} if values else None


@contextlib.contextmanager
def service(
    url: str, rig: Path | None, data: Path | None, emulate: str, over: Event
) -> Iterator[tuple[Client, Events]]:
    """Yield a client of the service at `url`, else of one started here, and its events; any key stops the rig.

    Once `over` is set nothing is played any more: a key then stops only what plays.
    """
    with contextlib.ExitStack() as stack:
        if url:
            token = os.environ.get("STIMRIG_TOKEN") or os.environ.get("STIMRIG_ADMIN_TOKEN")
            if not token:
                raise InputError(f"--url {url} needs a token in STIMRIG_TOKEN.")
            events, stop = list, at_service(url, token, over.is_set)
        else:
            settings, token = Settings(**set_options(rig_file=rig, data_dir=data, port=0)), secrets.token_urlsafe(32)
            services = stack.enter_context(Services(settings, emulate.split(), token))
            url, events, stop = services.url, services.watch, at_rig(services.socket, over.is_set)
        if stack.enter_context(StopKey(stop, print_aside)).watched:
            print_aside("any key stops the test")
        yield stack.enter_context(Client(url, token)), events


def play(
    client: Client,
    participant: str,
    request: dict[str, Any],
    events: Events = list,
    over: Callable[[], object] = list,
) -> dict[str, Any]:
    """Run a test; return its document, its best model and its recording. `events` and `over` as in `run_test`.

    Raises InputError: as `deciding.check_participant`, where the request has `recorded_ma`. CommandError, ServiceError.
    """
    if "recorded_ma" in request:  # it is no request of the service: nobody is made anew for a recording
        deciding.check_participant(client, participant, request.pop("recorded_ma"))
    document = run_test(client, participant, events, over, **request)
    best = document["model_id"]
    if (document.get("adaptive") or {}).get("problem"):
        print_aside("  the structure leaves an error: adding what explains it")
        with contextlib.suppress(ServiceError), progress_bar() as progress:  # the plain model is there all the same
            best = client.improve(best, progress)["id"]
    return {"test": document, "model": client.model_file(best), "recording": client.recording(document["recording_id"])}


def run_test(
    client: Client, participant: str, events: Events = list, over: Callable[[], object] = list, **request: Any
) -> dict[str, Any]:
    """Run a test, the default pre-session test unless `request` says otherwise, and show its progress.

    The participant is made unless it is there. `events`: one is enough to give up. `over` is called as soon as nothing
    of the test is played any more.

    Raises CommandError: a process has ended. Raises ServiceError: the test was refused, or did not complete.
    """
    shown = ""

    def watch(test: TestOut) -> None:
        nonlocal shown
        for event in events():
            raise CommandError(event)
        if test.state not in ("requested", "running"):
            over()
        segment, words = _progress(test)
        if sys.stderr.isatty():
            words, end = (test.state, "\n") if test.done else (words, "")
            print(f"{CLEAR_LINE}  {words}", end=end, file=sys.stderr, flush=True)
        elif segment != shown and not test.done:
            print(f"  {words}", file=sys.stderr, flush=True)
        shown = segment

    client.ensure_participant(participant)
    try:
        return client.run_test(participant, watch, **request).to_dict()
    except Unreachable as error:
        for event in events():
            raise CommandError(event) from error
        raise


def _progress(test: TestOut) -> tuple[str, str]:
    """Return the part of the test that goes on, and a line of how far it is."""
    if test.state == "identifying":
        segment = str((test.identification or {}).get("text") or "identifying")
        return segment, f"identification: {segment}"
    if test.adaptive and test.state == "running":
        segment = test.adaptive["problem"] or test.adaptive["words"] or "a first look at the muscle"
        return segment, f"{test.elapsed_s:4.1f} s  {test.adaptive['torque_time_nm_s'] or 0.0:.1f} N·m·s  {segment}"
    segment = test.segment or test.state
    return segment, f"{segment:10} {100 * test.progress:3.0f} %  {test.time_left_s:4.0f} s left"

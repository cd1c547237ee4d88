"""`stimrig test`: one pre-session test on the configured rig."""

from __future__ import annotations

import contextlib
import inspect
import math
import os
import secrets
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Annotated, Any

import typer

from stimrig.api.cli import deciding
from stimrig.api.cli.commands.diagnose import diagnosis_lines
from stimrig.api.cli.errors import CommandError, InputError
from stimrig.api.cli.files import writing
from stimrig.api.cli.options import DataDir, Emulate, Json, RigFile, set_options
from stimrig.api.cli.reports import report_test
from stimrig.api.cli.stop_key import StopKey, at_rig, at_service
from stimrig.api.cli.supervisor import Services
from stimrig.api.cli.terminal import CLEAR_LINE, number, say, say_aside, say_json
from stimrig.api.client.errors import ServiceError, Unreachable
from stimrig.api.client.rest import Client
from stimrig.api.progress_bar import progress_bar
from stimrig.api.settings import Settings
from stimrig.api.web.responses.rig import TestOut
from stimrig.rig.messages import LABEL_TITLES, Labels


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
        str | None, typer.Option(help="which fixed test: paper (default), short", show_default=False)
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
    bounds = set_options(max_duration_s=max_time, max_torque_time_nm_s=max_torque_time, anyway=anyway or None)
    request = kind_of_test(adaptive, protocol, target, bounds) | set_options(**labels)
    if decide and (adaptive or protocol is not None):
        raise InputError("--decide plays what the diagnosis asks for; leave out --adaptive and --protocol.")
    token = os.environ.get("STIMRIG_TOKEN") or os.environ.get("STIMRIG_ADMIN_TOKEN")
    check_output(output)
    if url and not token:
        raise InputError(f"--url {url} needs a token in STIMRIG_TOKEN.")
    if decide:
        request |= deciding.plan_experiment(decide, participant)
    code = request.pop("participant", participant or "TEST")
    if url and token:
        over = Event()
        with StopKey(at_service(url, token, over.is_set), say_aside) as key:
            announce(key)
            result = through(url, token, code, over=over.set, request=request)
    else:
        result = on_own_services(rig, data, emulate, code, request)
    recording = result.pop("recording")
    if output is not None:  # first, so that a later error cannot lose the recording
        with writing(output) as place:
            place.write_bytes(recording)
    if decide:
        result["diagnosis"] = deciding.diagnose_together(decide, recording)
    if as_json:
        say_json(result)
        return
    say(*report_test(result["test"], None if decide else result["model"]))
    if decide:
        say("", "both together", "", *diagnosis_lines(result["diagnosis"]), "")
        if result["diagnosis"]["left"]["structure"]:
            say("with what was added", "", *diagnosis_lines(result["diagnosis"]["left"]), "")
    say(f"recording      {output or result['test']['recording_url']}")


def take_labels(verb: Any) -> None:
    """Make an option of each label that a person types, in the place of the verb's keywords."""
    *parameters, _labels = inspect.signature(verb, eval_str=True).parameters.values()
    for name in LABEL_TITLES:
        option = Annotated[str | None, typer.Option(help=Labels.model_fields[name].description, show_default=False)]
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=option))
        verb.__annotations__[name] = option
    verb.__signature__ = inspect.Signature(parameters)


take_labels(test)


def check_output(output: Path | None) -> None:
    """Check that the recording can be written: a folder that is not there would be found after the test.

    Raises InputError: it cannot.
    """
    if output is None:
        return
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: {error.strerror}. Give a file in a folder that can be written.") from error
    if output.is_dir() or not os.access(output if output.exists() else output.parent, os.W_OK):
        raise InputError(f"{output}: give a file in a folder that can be written.")


def kind_of_test(adaptive: bool, protocol: str | None, target: str, bounds: dict[str, Any]) -> dict[str, Any]:
    """Return what the service is asked for beside the participant.

    Raises InputError: an option of adaptive tests without --adaptive, one of fixed tests with it, or what is no number.
    """
    if not adaptive:
        if bounds or target:
            raise InputError("--target, --max-time, --max-torque-time and --anyway go with --adaptive.")
        return set_options(protocol=protocol)
    if protocol is not None:
        raise InputError("--protocol is for a fixed test; leave it out, or leave out --adaptive.")
    for option, name in (("--max-time", "max_duration_s"), ("--max-torque-time", "max_torque_time_nm_s")):
        if not 0 < bounds.get(name, 1.0) < math.inf:
            raise InputError(f"{option} {bounds[name]:g}: give a number above 0.")
    return {"kind": "adaptive", **bounds, **({"target": target_of(target)} if target else {})}


def target_of(text: str) -> dict[str, float]:
    """Read a target as it is typed: one number for both curves, or two. Raises InputError: it is none."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(0 < value < math.inf for value in values):
        raise InputError(f"--target {text}: give one number, as 2, or two, as 2,3: % of the curve and step response.")
    return {"curve_percent": values[0], "step_percent": values[-1]}


def announce(key: StopKey) -> None:
    """Say that a key stops, where one does."""
    if key.watched:
        say_aside("any key stops the test")


def on_own_services(
    rig: Path | None, data: Path | None, emulate: str, participant: str, request: dict[str, Any]
) -> dict[str, Any]:
    """Start rig and service for this one test."""
    settings, token, over = Settings(**set_options(rig_file=rig, data_dir=data)), secrets.token_urlsafe(32), Event()
    settings.port = 0
    with (
        Services(settings, emulate.split(), token) as services,
        StopKey(at_rig(services.socket, over.is_set), say_aside) as key,
    ):
        announce(key)
        return through(services.url, token, participant, services.watch, over.set, request)


def through(
    url: str,
    token: str,
    participant: str,
    events: Callable[[], list[str]] = list,
    over: Callable[[], object] = list,
    request: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Run the test through a service; `events` and `over` as in `run_test`.

    Raises InputError: as `deciding.check_participant`, where the request has `recorded_ma`. ServiceError: the service
    cannot be reached, or the test did not end in a model.
    """
    more = dict(request or {})
    with Client(url, token) as client:
        if "recorded_ma" in more:  # it is no request of the service: nobody is made anew for a recording
            deciding.check_participant(client, participant, more.pop("recorded_ma"))
        document = run_test(client, participant, events, over, **more)
        best = document["model_id"]
        if (document.get("adaptive") or {}).get("problem"):
            say_aside("  the structure leaves an error: adding what explains it")
            with contextlib.suppress(ServiceError), progress_bar() as progress:  # the plain model is there all the same
                best = client.improve(best, progress)["id"]
        model = client.model_file(best)
        return {"test": document, "model": model, "recording": client.recording(document["recording_id"])}


def run_test(
    client: Client,
    participant: str,
    events: Callable[[], list[str]] = list,
    over: Callable[[], object] = list,
    **more: Any,
) -> dict[str, Any]:
    """Run a test, the default pre-session test unless `more` says otherwise, and show its progress.

    The participant is made unless it is there. `events` says which processes of the service have ended; one is enough
    to give up. `over` is called as soon as nothing of the test is played any more.

    Raises CommandError: a process has ended. Raises ServiceError: the test was refused, or did not complete.
    """
    show = Progress()

    def watch(test: TestOut) -> None:
        for event in events():
            raise CommandError(event)
        if test.state not in ("requested", "running"):
            over()
        show(test)

    client.ensure_participant(participant)
    try:
        return client.run_test(participant, watch, **more).to_dict()
    except Unreachable as error:
        for event in events():
            raise CommandError(event) from error
        raise


class Progress:
    """A progress line: on a terminal in place, elsewhere a line a segment."""

    def __init__(self) -> None:
        self.terminal, self.last = sys.stderr.isatty(), ""

    def __call__(self, test: TestOut) -> None:
        """Show where the test stands."""
        if test.state == "identifying":
            segment = (test.identification or {}).get("text") or "identifying"
            words = f"identification: {segment}"
        elif test.adaptive and test.state == "running":
            segment = test.adaptive["problem"] or test.adaptive["words"] or "a first look at the muscle"
            words = f"{test.elapsed_s:4.1f} s  {number(test.adaptive['torque_time_nm_s'], 1)} N·m·s  {segment}"
        else:
            segment = test.segment or test.state
            words = f"{segment:10} {100 * test.progress:3.0f} %  {test.time_left_s:4.0f} s left"
        if self.terminal:
            words, end = (test.state, "\n") if test.done else (words, "")
            print(f"{CLEAR_LINE}  {words}", end=end, file=sys.stderr, flush=True)
        elif segment != self.last and not test.done:
            print(f"  {words}", file=sys.stderr, flush=True)
        self.last = segment

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
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.launcher import Services
from stimrig.api.cli.session_report import report_lines, run_test
from stimrig.api.cli.stop_key import StopKey, at_rig, at_service
from stimrig.api.cli.terminal import Json, given, say, say_json, writing
from stimrig.api.client.errors import ServiceError
from stimrig.api.client.rest import Client
from stimrig.api.progress_bar import progress_bar
from stimrig.api.settings import Settings
from stimrig.rig.messages import LABEL_TITLES, Labels


def test(
    participant: Annotated[
        str | None,
        typer.Option(
            help="participant's code; default TEST, or with --decide whose the recording is", show_default=False
        ),
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: the emulated rig")] = None,
    url: Annotated[str, typer.Option(help="a running service; default: one is started", envvar="STIMRIG_URL")] = "",
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    protocol: Annotated[
        str | None, typer.Option(help="which fixed test: paper (default), short", show_default=False)
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write the recording (HDF5) here")] = None,
    emulate: Annotated[str, typer.Option(help='options for the emulator, e.g. "--patient calcium"')] = "",
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
    asked = how(adaptive, protocol, target, max_time, max_torque_time, anyway) | given(**labels)
    if decide and (adaptive or protocol is not None):
        raise InputError("--decide plays what the diagnosis asks for; leave out --adaptive and --protocol.")
    token = os.environ.get("STIMRIG_TOKEN") or os.environ.get("STIMRIG_ADMIN_TOKEN")
    check_output(output)
    if url and not token:
        raise InputError(f"--url {url} needs a token in STIMRIG_TOKEN.")
    if decide:
        asked |= deciding.asked(decide, participant)
    code = asked.pop("participant", participant or "TEST")
    if url and token:
        over = Event()
        with StopKey(at_service(url, token, over.is_set), say_aside) as key:
            announce(key)
            found = through(url, token, code, over=over.set, asked=asked)
    else:
        found = on_own_services(rig, data, emulate, code, asked)
    recording = found.pop("recording")
    if output is not None:  # first: what was measured is not lost, whatever comes after
        with writing(output) as place:
            place.write_bytes(recording)
    if decide:
        found["diagnosis"] = deciding.diagnosed(decide, recording)
    if as_json:
        say_json(found)
        return
    say(*report_lines(found["test"], None if decide else found["model"]))
    if decide:
        say("", "both together", "", *diagnosis_lines(found["diagnosis"]), "")
        if found["diagnosis"]["left"]["structure"]:
            say("with what was added", "", *diagnosis_lines(found["diagnosis"]["left"]), "")
    say(f"recording      {output or found['test']['recording_url']}")


def check_output(output: Path | None) -> None:
    """See that the recording can be written: a folder that is not there would be found after the test.

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


def take_labels(verb: Any) -> None:
    """Make an option of each label that a person types, in the place of the verb's keywords."""
    *parameters, _labels = inspect.signature(verb, eval_str=True).parameters.values()
    for name in LABEL_TITLES:
        says = Annotated[str | None, typer.Option(help=Labels.model_fields[name].description, show_default=False)]
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=says))
        verb.__annotations__[name] = says
    verb.__signature__ = inspect.Signature(parameters)


take_labels(test)


def how(
    adaptive: bool,
    protocol: str | None,
    target: str,
    max_time: float | None,
    max_torque_time: float | None,
    anyway: bool,
) -> dict[str, Any]:
    """What the service is asked for beside the participant.

    Raises InputError: an option of adaptive tests without --adaptive, one of fixed tests with it, or what is no number.
    """
    bounds = given(max_duration_s=max_time, max_torque_time_nm_s=max_torque_time)
    asked = bounds | given(anyway=anyway or None)
    if not adaptive:
        if asked or target:
            raise InputError("--target, --max-time, --max-torque-time and --anyway go with --adaptive.")
        return {} if protocol is None else {"protocol": protocol}
    if protocol is not None:
        raise InputError("--protocol is for a fixed test; leave it out, or leave out --adaptive.")
    for option, value in (("--max-time", max_time), ("--max-torque-time", max_torque_time)):
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"{option} {value:g}: give a number above 0.")
    return {"kind": "adaptive", **asked, **({"target": target_of(target)} if target else {})}


def target_of(text: str) -> dict[str, float]:
    """A target as it is typed: one number for both curves, or two. Raises InputError: it is none."""
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


def say_aside(words: str) -> None:
    """On standard error, on a line of its own: standard output is the result's."""
    print(f"\r\x1b[K{words}" if sys.stderr.isatty() else words, file=sys.stderr, flush=True)


def on_own_services(
    rig: Path | None, data: Path | None, emulate: str, participant: str, asked: dict[str, Any]
) -> dict[str, Any]:
    """Start rig and service for this one test."""
    settings = Settings(**given(rig_file=rig, data_dir=data))
    settings.port = 0
    token = secrets.token_urlsafe(32)

    over = Event()
    with (
        Services(settings, emulate.split(), token) as services,
        StopKey(at_rig(services.socket, over.is_set), say_aside) as key,
    ):
        announce(key)
        return through(services.url, token, participant, services.watch, over.set, asked)


def through(
    url: str,
    token: str,
    participant: str,
    events: Callable[[], list[str]] = list,
    over: Callable[[], object] = list,
    asked: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The test through a service; `events` and `over` as in `run_test`.

    Raises InputError: as `deciding.check_participant`, where `asked` has `recorded_ma`. ServiceError: the service
    cannot be reached, or the test did not end in a model.
    """
    more = dict(asked or {})
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

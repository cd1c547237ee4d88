"""`stimrig`: one verb a file in `api/cli/commands`; errors become one line and an exit code here, nowhere else.

0 done; 1 something failed; 2 bad input, one line on standard error; never a traceback.
"""

from __future__ import annotations

import ast
import ctypes
import gc
import importlib
import os
import pkgutil
import signal
import sys
import tempfile
import threading
import traceback
from pathlib import Path
from typing import Annotated

import typer
from typer.exceptions import TyperException

from stimrig.api.cli import commands
from stimrig.api.cli.errors import INTERRUPTED, CommandError, exit_interrupted
from stimrig.api.client.errors import Forbidden, Invalid, NotFound, ServiceError, Unauthorized, Unreachable
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.version import software_version
from stimrig.identify.errors import IdentifyError

COMPUTES = {"compare", "diagnose", "explain", "export", "fit", "improve", "invert", "predict", "table1"}
"""Verbs that only compute: they hold no device, and Ctrl-C may end them whatever they are in."""
GRACE_S = 0.7
"""For what is to be tidied up after Ctrl-C."""
KEPT_BYTES = 1 << 25
"""Memory below this size is kept once it is free, where the C library can be told so."""
MALLOC_LIMITS = -1, -3
"""Of `mallopt`: from which size on free memory goes back to the system, and memory is asked from it alone."""
interrupted = threading.Event()
VERBS = sorted(info.name for info in pkgutil.iter_modules(commands.__path__))
INPUT_AT_FAULT = (Unreachable, Unauthorized, Forbidden, NotFound, Invalid)
"""Errors of a service that stand for a wrong address, a wrong token or a request that cannot be used."""


def build(verb: str = "") -> typer.Typer:
    """Make the command line with the verb's file in `api/cli/commands`; with every file where none bears its name.

    No verb waits until the libraries of all others are loaded.
    """
    app = _empty()
    for name in [verb] if verb in VERBS else VERBS:
        module = importlib.import_module(f"{commands.__name__}.{name}")
        if hasattr(module, "register"):
            module.register(app)
        else:
            app.command(name)(getattr(module, name))
    return app


def _overview() -> typer.Typer:
    """Make the command line as its help lists it: the first line of each verb's file, which is read and not loaded."""
    app = _empty()
    for name in VERBS:
        text = (Path(commands.__path__[0]) / f"{name}.py").read_text("utf-8")
        words = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0].partition(": ")[2]
        app.command(name, help=words[:1].upper() + words[1:])(lambda: None)
    return app


def _empty() -> typer.Typer:
    app = typer.Typer(
        name="stimrig",
        help="Identify electrically stimulated muscle, see where the model fails, learn what is missing.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)  # one verb alone stays a verb
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"stimrig {software_version()}")
        raise typer.Exit


def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print it")
    ] = False,
) -> None: ...


def main(arguments: list[str]) -> None:
    """Run a verb and leave with its exit code."""
    # The libraries allocate half a million permanent objects; collecting garbage among them, repeatedly and at exit,
    # takes longer than a fit.
    gc.set_threshold(50_000)
    computes = COMPUTES.intersection(arguments[:1])
    if computes and sys.platform == "linux" and (limit := getattr(ctypes.CDLL(None), "mallopt", None)):
        # A fit makes and drops arrays all the time: the system would clear each anew, a tenth of the processor's time.
        for number in MALLOC_LIMITS:
            limit(number, KEPT_BYTES)
    signal.signal(signal.SIGINT, _interrupt if computes else signal.default_int_handler)
    code = run(arguments)
    signal.signal(signal.SIGINT, exit_interrupted)
    if computes and code == INTERRUPTED:  # Python itself would end by the signal, where it went through an exec
        os._exit(code)
    gc.freeze()
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run a verb; return its exit code."""
    # Matrices of a fit are small: a second BLAS thread only waits for the first, and on a busy machine for long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    verb = next((word for word in arguments if word[:1] != "-"), "")
    try:
        code = (build(verb) if verb in VERBS else _overview())(arguments, standalone_mode=False)
        sys.stdout.flush()
        if code == INTERRUPTED:  # typer has caught it
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the reader has closed the pipe
        return 0
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt | typer.Abort) or interrupted.is_set():  # a library may have changed it
            print("stimrig: interrupted", file=sys.stderr)
            return INTERRUPTED
        words, code = _explain(verb, arguments, error)
        if not words.startswith("Usage:"):  # the help itself, where no verb was given
            words = f"stimrig{f' {verb}' if verb in VERBS else ''}: {' '.join(words.split())}"
        print(words, file=sys.stderr)
        return code


def _interrupt(*_: object) -> None:
    """Ctrl-C: an exception, and the end of the process where it is not heard: a library may call us from its C code,
    which drops exceptions, or compute for seconds before it looks."""
    interrupted.set()
    late = threading.Timer(GRACE_S, exit_interrupted)
    late.daemon = True
    late.start()
    raise KeyboardInterrupt


def _explain(verb: str, arguments: list[str], error: BaseException) -> tuple[str, int]:
    """Return what an error says to the person, and the exit code it stands for."""
    if isinstance(error, TyperException):
        words = error.format_message().strip()
        if not words or words.startswith("Usage:"):
            return words or "Usage: stimrig --help lists the verbs", 2
        return f"{words} (see stimrig {verb} --help)", 2
    if isinstance(error, CommandError):
        return str(error), error.exit_code
    if isinstance(error, ApiError | SettingsError):
        return str(error), 2
    if isinstance(error, IdentifyError):
        # the files of the command line, where it is of what they hold and names none of them
        files = [word for word in arguments if word[:1] != "-" and Path(word).is_file()]
        return f"{', '.join(files)}: {error}" if files and not error.place else str(error), 2
    if isinstance(error, ServiceError):
        at_fault = isinstance(error, INPUT_AT_FAULT) or error.code == "rig-disconnected"
        return str(error), 2 if at_fault else 1
    if isinstance(error, ModuleNotFoundError) and not (error.name or "").startswith("stimrig"):
        extra = "cohort" if verb == "cohort" else "page"
        return f"needs more packages: pip install 'stimrig[{extra}]' ({error.name} is missing)", 2
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}. Give a file that can be read, or a place that can be written.", 2
    log = Path(tempfile.gettempdir()) / f"stimrig-error-{os.getpid()}.log"
    log.write_text("".join(traceback.format_exception(error)))
    return f"unexpected: {type(error).__name__}: {error} (log: {log})", 1

"""`stimrig`: one verb a file in `api/cli/commands`; errors become one line and an exit code here, nowhere else.

0 done; 1 something failed; 2 bad input, one line on standard error; never a traceback.
"""

from __future__ import annotations

import ast
import contextlib
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
from stimrig.api.cli.errors import INTERRUPTED, PAGE, CommandError, exit_interrupted
from stimrig.api.client.errors import Forbidden, Invalid, NotFound, ServiceError, Unauthorized, Unreachable
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.version import software_version
from stimrig.identify.errors import IdentifyError

COMPUTES = {"compare", "diagnose", "explain", "export", "fit", "improve", "invert", "predict", "table1"}
"""Verbs that only compute: they hold no device, and Ctrl-C may end them whatever they are in."""
PACKAGE = Path(__file__).resolve().parents[1]
GRACE_S = 0.7
"""For what is to be tidied up after Ctrl-C."""
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
    """Make the command line as its help lists it: what each verb does, read from its file and not loaded."""
    app, groups = _empty(), {}
    for name in VERBS:
        tree = ast.parse((Path(commands.__path__[0]) / f"{name}.py").read_text("utf-8"))
        does = {node.name: ast.get_docstring(node) for node in tree.body if isinstance(node, ast.FunctionDef)}
        if name in does:
            app.command(name, help=does[name])(lambda: None)
        else:
            calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
            group = next(call for call in calls if ast.unparse(call.func) == "typer.Typer")
            groups[name] = next(ast.literal_eval(word.value) for word in group.keywords if word.arg == "help")
    for name, words in groups.items():  # verbs with verbs of their own stand behind the others
        app.command(name, help=words)(lambda: None)
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


def main(arguments: list[str] | None = None) -> None:
    """Run a verb and leave with its exit code."""
    # The libraries allocate half a million permanent objects; collecting garbage among them, repeatedly and at exit,
    # takes longer than a fit.
    gc.set_threshold(50_000)
    computes = COMPUTES.intersection(sys.argv[1:2] if arguments is None else arguments[:1])
    signal.signal(signal.SIGINT, _interrupt if computes else signal.default_int_handler)
    code = run(arguments)
    signal.signal(signal.SIGINT, exit_interrupted)
    if computes and code == INTERRUPTED:  # Python itself would end by the signal, where it went through an exec
        os._exit(code)
    gc.freeze()
    sys.exit(code)


def run(arguments: list[str] | None = None) -> int:
    """Run a verb; return its exit code."""
    # Matrices of a fit are small: a second BLAS thread only waits for the first, and on a busy machine for long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _keep_compiled()
    words = arguments if arguments is not None else sys.argv[1:]
    verb = next((word for word in words if word[:1] != "-"), "")
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
        name = f"stimrig {verb}" if verb in VERBS else "stimrig"
        line, code = _explain(name, words, error)
        print(line, file=sys.stderr)
        return code


def _keep_compiled() -> None:
    """Use this user's cache for numba, also in workers, where the installation belongs to another user."""
    if "NUMBA_CACHE_DIR" in os.environ or os.access(PACKAGE, os.W_OK):
        return
    with contextlib.suppress(OSError, RuntimeError):  # no home: `stimrig doctor` tells what follows
        place = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stimrig" / "numba"
        place.mkdir(parents=True, exist_ok=True)
        os.environ["NUMBA_CACHE_DIR"] = str(place)


def _interrupt(*_: object) -> None:
    """Ctrl-C: an exception, and the end of the process where it is not heard: a library may call us from its C code,
    which drops exceptions, or compute for seconds before it looks."""
    interrupted.set()
    late = threading.Timer(GRACE_S, exit_interrupted)
    late.daemon = True
    late.start()
    raise KeyboardInterrupt


def _explain(name: str, words: list[str], error: BaseException) -> tuple[str, int]:
    """Return the error's line, and the exit code it stands for."""
    if isinstance(error, TyperException):
        message = error.format_message().strip()
        if not message or message.startswith("Usage:"):  # no verb was given: the help itself, not in one line
            return message, 2
        return f"{name}: {flat(message)} (see {name} --help)", 2
    if isinstance(error, CommandError | IdentifyError | ApiError | SettingsError):
        # the files of the command line, where it is of what they hold and names none of them
        files = [word for word in words if word[:1] != "-" and Path(word).is_file()]
        about = f"{', '.join(files)}: " if isinstance(error, IdentifyError) and not error.place and files else ""
        return f"{name}: {flat(f'{about}{error}')}", error.exit_code if isinstance(error, CommandError) else 2
    if isinstance(error, ServiceError):
        at_fault = isinstance(error, INPUT_AT_FAULT) or error.code == "rig-disconnected"
        return f"{name}: {flat(str(error))}", 2 if at_fault else 1
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in PAGE:
        return f"{name}: needs rig, service and page: pip install 'stimrig[page]' ({error.name} is missing)", 2
    log = Path(tempfile.gettempdir()) / f"stimrig-error-{os.getpid()}.log"
    log.write_text("".join(traceback.format_exception(error)))
    return f"{name}: unexpected: {type(error).__name__}: {flat(str(error))} (log: {log})", 1


def flat(text: str) -> str:
    """Write text on one line."""
    return " ".join(text.split())

"""`stimrig emulate`: the emulated rig alone, its own process."""

from __future__ import annotations

import os
import sys

import typer


def register(app: typer.Typer) -> None:
    """Add the verb; its options are the emulator's own."""
    settings = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
    app.command("emulate", context_settings=settings, add_help_option=False)(emulate)


def emulate(context: typer.Context) -> None:
    """The emulated rig alone: devices on a pseudo-terminal and a CAN server (--help lists its options)."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", "stimrig.hardware_sim", *context.args])

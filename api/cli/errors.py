"""Errors that end a command: one line on standard error and an exit code."""

from __future__ import annotations

import os

INTERRUPTED = 130


def exit_interrupted(*_: object) -> None:
    """Exit at once after Ctrl-C: nothing has begun, or the interrupt was not handled in time."""
    os.write(2, b"stimrig: interrupted\n")
    os._exit(INTERRUPTED)


class CommandError(Exception):
    """A verb cannot go on; its words go to the person.

    `message`: one line: the place, what is wrong, what to do; `exit_code`: 1: something failed. 2: the input was at
    fault.
    """

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class InputError(CommandError):
    """Bad input: exit 2."""

    def __init__(self, message: str) -> None:
        super().__init__(message, 2)


class LaunchError(CommandError):
    """A process did not start, or ended."""

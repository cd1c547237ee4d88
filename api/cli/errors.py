"""What ends a verb: one line on standard error and an exit code."""

from __future__ import annotations


class CommandError(Exception):
    """A verb cannot go on; its words go to the person.

    Parameters
    ----------
    message : str
        One line: the place, what is wrong, what to do.
    exit_code : int
        1: something failed. 2: the input was at fault.
    """

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class InputError(CommandError):
    """Bad input: exit 2."""

    def __init__(self, message: str) -> None:
        super().__init__(message, 2)


class LaunchError(CommandError):
    """A process did not come up, or ended."""

"""Python imports a module of this name first: a test's child joins paced time here (`paced_clock.py`)."""

from paced_clock import join_as_child  # pyright: ignore[reportMissingImports]: this folder is on the child's path

join_as_child()

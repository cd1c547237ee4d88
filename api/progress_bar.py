"""Show how far long work is, on terminals and in notebooks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE_S = 1.0
"""Work that takes no longer shows no bar."""
BAR = "{percentage:3.0f} % {bar:20} {remaining} left  {desc}"
LOG_S = 60.0
LONGEST = 60
"""Characters of the text beside the bar."""


@contextmanager
def progress_bar(wanted: bool = True) -> Iterator[Callable[[float, str], None]]:
    """Show a bar after a second, if somebody looks; yields what takes a share, 0 to 1, and a line of text."""
    if not wanted or not (in_notebook() or sys.stderr.isatty()):
        yield lambda _share, _text="": None
        return
    from tqdm.auto import tqdm

    with tqdm(total=1.0, delay=PATIENCE_S, miniters=0, mininterval=0, leave=False, bar_format=BAR) as bar:

        def show(share: float, text: str = "") -> None:
            bar.set_description_str(text[:LONGEST], refresh=False)
            bar.update(share - bar.n)

        yield show


def records_bar(total: int) -> Any:
    """Return a bar for many records, to be updated with each: at a terminal; a line a minute in a log."""
    from tqdm.auto import tqdm

    watched = sys.stderr.isatty() or in_notebook()
    delay_s, interval_s = (1.0, 0.1) if watched else (LOG_S, LOG_S)
    return tqdm(total=total, unit=" records", leave=not watched, delay=delay_s, mininterval=interval_s)


def in_notebook() -> bool:
    """Tell whether this process is the kernel of a notebook; its standard error is no terminal."""
    ipython = sys.modules.get("IPython")
    shell = ipython and ipython.get_ipython()
    return bool(shell) and "IPKernelApp" in shell.config

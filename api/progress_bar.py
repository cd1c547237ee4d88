"""A progress bar for long work, on terminals and in notebooks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 1.0
"""Work that takes no longer shows no bar."""
FORMAT = "{percentage:3.0f} % {bar:20} {remaining} left  {desc}"
LONGEST = 60
"""Characters of the text beside the bar."""


@contextmanager
def progress_bar(wanted: bool = True) -> Iterator[Callable[[float, str], None]]:
    """A bar that is shown after a second, if somebody looks, and is gone in the end.

    Parameters
    ----------
    wanted : bool
        False: no bar in any case.

    Yields
    ------
    callable
        Takes the share that is done, 0 to 1, and a line of text.
    """
    if not wanted or not (in_notebook() or sys.stderr.isatty()):
        yield lambda _share, _text="": None
        return
    from tqdm.auto import tqdm  # here: a verb that shows no bar does not wait for it

    with tqdm(total=1.0, delay=PATIENCE_S, miniters=0, mininterval=0, leave=False, bar_format=FORMAT) as bar:

        def tell(share: float, text: str = "") -> None:
            bar.set_description_str(text[:LONGEST], refresh=False)
            bar.update(share - bar.n)

        yield tell


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook; its standard error is no terminal."""
    ipython = sys.modules.get("IPython")
    shell = ipython and ipython.get_ipython()
    return bool(shell) and "IPKernelApp" in shell.config

"""Long work of `identify` with a progress bar in notebooks and terminals: `stimrig.fit`, `stimrig.diagnose` and others.

`progress` is True (a bar, if the work takes longer than a second), False (none), or a function of one's own that takes
a share of 0 to 1 and a line of text. All other parameters, results and errors are those of `identify`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import Any, TypeVar

from stimrig.api.progress_bar import progress_bar

Result = TypeVar("Result")


def with_bar(verb: Callable[..., Result]) -> Callable[..., Result]:
    """A function of `identify` that takes `progress`, with a bar by default."""
    signature = inspect.signature(verb)

    @wraps(verb)
    def call(*arguments: Any, **options: Any) -> Result:
        bound = signature.bind(*arguments, **options)
        progress = bound.arguments.get("progress", True)
        with nullcontext(progress) if callable(progress) else progress_bar(bool(progress)) as report:
            bound.arguments["progress"] = report
            return verb(*bound.args, **bound.kwargs)

    return call

"""Progress of work on many records: a bar at a terminal, a line a minute in a log."""

from __future__ import annotations

import sys
from typing import Any

from stimrig.api.progress_bar import in_notebook

LOG_S = 60.0


def records_bar(total: int) -> Any:
    """Return a tqdm bar on standard error, to be updated with each record."""
    from tqdm.auto import tqdm

    watched = sys.stderr.isatty() or in_notebook()
    delay_s, interval_s = (1.0, 0.1) if watched else (LOG_S, LOG_S)
    return tqdm(total=total, unit=" records", leave=not watched, delay=delay_s, mininterval=interval_s)

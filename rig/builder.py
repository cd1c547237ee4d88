"""`python -m rig.builder`: builds previews for the rig, apart from it (see `rig.control.previews`).

Takes the rig's limits as the first line on standard input, then one preview's request a line, and gives one reply a
line. Ends with its standard input, or with the rig. It yields the processor to everybody and may use so much memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import sys
from pathlib import Path

MOST_MEMORY_BYTES = 1 << 30
PR_SET_PDEATHSIG = 1


def main() -> int:
    """Until standard input ends."""
    _modest()
    from rig.control.building import serve  # only now: it is numpy that takes its time

    serve(sys.stdin.buffer, sys.stdout.buffer)
    return 0


def _modest() -> None:
    """Before anything else is loaded: behind everybody at the processor, first to go where memory runs out."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the rig's, which ends this one
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(5)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))


if __name__ == "__main__":
    sys.exit(main())

"""`python -m stimrig.rig.builder previews` (or `live`): what the rig has built by a process of its own.

Previews: the first line on standard input holds the rig's limits; each further line is the request for one preview, and
gets one line as its reply. Live: each pickled `Taken` gets two lines. An empty line says that it takes them. Both are
asked by `rig.adapters.builders`. The process ends when its standard input ends, or with the rig. It has a lower
priority at the processor than the rig, for previews the lowest, and a limit on its memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import sys
from pathlib import Path

MAX_MEMORY_BYTES = 1 << 30
PR_SET_PDEATHSIG = 1


def main(builds: str) -> int:
    _modest(5 if builds == "previews" else 0)
    from stimrig.rig import logs
    from stimrig.rig.control import live, replies  # after the limits are set: importing numpy takes time

    logs.configure(f"builder-{builds}")
    print(flush=True)
    {"previews": replies.serve, "live": live.serve}[builds](sys.stdin.buffer, sys.stdout.buffer)
    return 0


def _modest(nice: int) -> None:
    """Low priority and a memory limit, set before anything else; if memory runs out, this process is ended first."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the rig, which then ends this process
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(nice)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

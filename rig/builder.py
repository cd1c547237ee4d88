"""`python -m stimrig.rig.builder`: builds previews in a process of its own, as `rig.adapters.builders` asks.

The first line on standard input holds the rig's limits; each further pair of lines is the request for one preview, and
gets one line as its reply. An empty line says that it takes them. The process ends when its standard input ends, or
with the rig. It has the lowest priority at the processor, and a limit on its memory.
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


def main() -> int:
    _modest(5)
    from stimrig.rig import logs
    from stimrig.rig.control import replies  # after the limits are set: importing numpy takes time

    logs.configure("builder-previews")
    print(flush=True)
    replies.serve(sys.stdin.buffer, sys.stdout.buffer)
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
    sys.exit(main())

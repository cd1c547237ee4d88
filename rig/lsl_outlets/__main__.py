"""`python -m stimrig.rig.lsl_outlets --data DIR`: sends torque and pulses of the running test to Lab Streaming Layer.

It prints one JSON line on standard output when the outlets are open, and logs to standard error. It runs until SIGTERM
or SIGINT. Exit 2: LSL is not installed, or the data folder is not suitable.
"""

from __future__ import annotations

import contextlib
import os
import resource
import sys
from pathlib import Path

MAX_MEMORY_BYTES = 2 << 30


def main() -> int:
    _modest()
    from stimrig.rig.lsl_outlets.streaming import main as stream  # after that: importing numpy takes time

    return stream()


def _modest() -> None:
    """Less than the workers (nice 5), never waking before others; a limit on memory, and first to go if it runs out.

    Not SCHED_IDLE: beside two fits it gets too little of a processor to follow a test.
    """
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # each of its threads takes memory, and there is nothing for them to do
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(10)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("800")
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))


if __name__ == "__main__":
    sys.exit(main())

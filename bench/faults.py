"""The fault campaign: each fault, in each phase of a test, on several seeds; the table goes to docs/results/faults.md.

    python -m bench.faults [--resume] [--injections N] [--minutes M] [--workers N] [--seed N] [--speed N] [--out FILE]
    python -m bench.faults --table-only      writes the table of what --out holds

An emulator and a rig on it for each worker, in real time unless --speed says otherwise (then the rig's watches still
wait for real milliseconds). Every injection is appended to --out as a line of JSON at once, so that an interrupted
campaign can be resumed with --resume. Times are real milliseconds. Needs root for a full disk (a small tmpfs).
"""

from __future__ import annotations

import sys

from tests.harness.campaign.command import main

if __name__ == "__main__":
    sys.exit(main())

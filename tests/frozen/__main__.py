"""`python -m tests.frozen make`: write what users hold; `check`: compare this tree with it. See README.md here."""

from __future__ import annotations

import argparse
import re
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from tests.frozen.parts import PARTS, compare, keep


def main(arguments: list[str] | None = None) -> int:
    """The exit code: 1 if anything differs or cannot be made."""
    parser = argparse.ArgumentParser(prog="python -m tests.frozen", description=__doc__)
    parser.add_argument("what", choices=["make", "check"])
    parser.add_argument("--only", default="", metavar="PATTERN", help="parts whose name fits")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--most", type=int, default=12, help="lines for a part")
    asked = parser.parse_args(arguments)
    parts = [part for part in PARTS if re.search(asked.only, part)]
    if not parts:
        parser.error(f"no part fits {asked.only!r}")
    bad = 0
    # processes, not threads: a part sets the time zone and puts functions in the place of others for all of its
    # process, and HDF5 has one file in memory by the name under which the rig's code seals
    with ProcessPoolExecutor(asked.jobs, get_context("spawn")) as pool:
        running = {pool.submit(keep if asked.what == "make" else compare, part): part for part in parts}
        for k, done in enumerate(as_completed(running), 1):
            try:
                lines, words = done.result()
            except Exception as error:  # the other parts are compared all the same
                lines, words = str(error.__cause__ or error).splitlines()[-asked.most :], "cannot be made"
            bad += len(lines)
            print("\n    ".join([f"{k} of {len(parts)}: {running[done]}: {words}", *lines[: asked.most]]), flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())

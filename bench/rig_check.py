"""Planted faults of a rig, and sound rigs: which of them `stimrig rig check` tells, with which mend.

python -m bench.rig_check [--sound N] [--seed N]

In simulated time, on the emulated devices. A fault counts as found where it alone is told, with its mend. Exit 1 if one
is missed, or something is told of a sound rig.
"""

from __future__ import annotations

import logging
import sys

from bench.common import line, parser, table
from stimrig.rig.check import steps
from tests.harness.rig_checks import Checked
from tests.harness.rig_faults import PLANTED, sound_rigs


def main() -> None:
    """Run, and print one line for each rig."""
    made = parser(__doc__)
    made.add_argument("--sound", type=int, default=20, help="sound rigs to check beside")
    made.add_argument("--seed", type=int, default=1000, help="the first; bounds were chosen with those below 1000")
    given = made.parse_args()
    count = given.sound
    logging.disable(logging.CRITICAL)
    print(*table(["planted", "told", "mend", "found"], []), sep="\n")
    found = 0
    for seed, planted in enumerate(PLANTED, given.seed):
        told = Checked(planted, seed).found
        right = told == [planted.fault]
        found += right
        mend = "; ".join(steps.faults()[one].mend for one in told)
        print(line([planted.name, ", ".join(told) or "nothing", mend, "yes" if right else "NO"]), flush=True)
    false = 0
    for planted, seed, noise_nm in sound_rigs(count, given.seed):
        checked = Checked(planted, seed, noise_nm)
        wrong = checked.report["verdict"] != "sound"
        false += wrong
        name = f"sound: {planted.name}, seed {seed}, noise {noise_nm:g} N·m"
        print(line([name, ", ".join(checked.found) or "nothing", "", "NO" if wrong else "yes"]), flush=True)
    print(f"\n{found} of {len(PLANTED)} planted faults found, {false} false on {count} sound rigs")
    sys.exit(1 if found < len(PLANTED) or false else 0)


if __name__ == "__main__":
    main()

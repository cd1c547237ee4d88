"""Upgrade from version 0.1's schema and back, killed again and again: what is lost, and what is half.

    python -m bench.upgrades [--people 200] [--recordings 500] [--moments 50] [--by-statement] [--json FILE]

In each round one thing more is made in the new version, and one in the old. A process that upgrades, or goes
back, is killed by SIGKILL after a share of the time that it takes, or before one of its statements; the second call
must bring it to its end. `half`: after a kill the database is neither whole and old nor whole and new. `lost`: rows,
columns of them, or files that are not what they were.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench.common import keep, parser, table, written_by
from tests.harness.upgrades import campaign


def main() -> int:
    made = parser(__doc__)
    made.add_argument("--people", type=int, default=200)
    made.add_argument("--recordings", type=int, default=500)
    made.add_argument("--moments", type=int, default=50)
    made.add_argument("--by-statement", action="store_true", help="kill before a statement, not after a time")
    made.add_argument("--json", type=Path)
    asked = made.parse_args()
    with tempfile.TemporaryDirectory(prefix="stimrig-upgrades-") as folder:
        place = Path(folder) / "data"
        found = campaign(place, asked.people, asked.recordings, asked.moments, asked.by_statement)
    keep(asked.json, found)
    print(written_by("python -m bench.upgrades"))
    row = (found["people"], found["recordings"], *found["killed"].values(), len(found["lost"]), len(found["half"]))
    print("\n".join(table(("people", "recordings", "killed up", "killed back", "lost", "half"), [row])))
    print("\n".join([*found["lost"][:10], *found["half"][:10]]))
    return int(bool(found["lost"] or found["half"] or not found["whole"]))


if __name__ == "__main__":
    raise SystemExit(main())

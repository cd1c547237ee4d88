"""`python -m deploy.technical_file.audit`: pip-audit on the locks; a package that was not asked about is a failure.

pip-audit ends well when its service knows nothing of a package, or of all of them; then nothing was found out.
Exit 0: every package was asked about, and none is known to be vulnerable. 1: otherwise. Needs a network.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from deploy import soup

AUDIT = [sys.executable, "-m", "pip_audit", "--no-deps", "--disable-pip", "--progress-spinner", "off", "-f", "json"]


def faults(document: dict[str, Any]) -> Iterator[str]:
    """A line for each vulnerable package, and one for those that were not asked about."""
    skipped = [one["name"] for one in document["dependencies"] if "skip_reason" in one]
    for one in document["dependencies"]:
        yield from (f"{one['name']} {one['version']}: {found['id']}" for found in one.get("vulns", []))
    if skipped:
        yield f"not asked about: {len(skipped)} of {len(document['dependencies'])}: {', '.join(skipped[:5])} …"


def main() -> int:
    """Ask for both locks."""
    found = []
    for lock in (soup.LOCK, soup.EXTRAS):
        done = subprocess.run([*AUDIT, "-r", str(lock)], capture_output=True, text=True)
        try:
            found += [f"{lock.name}: {fault}" for fault in faults(json.loads(done.stdout))]
        except ValueError:
            found.append(f"{lock.name}: no answer: {(done.stderr.strip().splitlines() or ['?'])[-1]}")
    print("\n".join(found) or "every package asked about, none known to be vulnerable")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m bench [NAME …] [OPTIONS]`: table1, rivals, diagnosis; all of them without a name.

Options are those of `rivals` or `diagnosis`.
"""

from __future__ import annotations

import os
import sys

NAMES = ("table1", "rivals", "diagnosis")
OPTIONS = {"diagnosis": [], "rivals": ["--write"]}


def main() -> int:
    from importlib import import_module

    cut = next((at for at, word in enumerate(sys.argv) if word.startswith("-")), len(sys.argv))
    names, options = sys.argv[1:cut] or list(NAMES), sys.argv[cut:]
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        print(f"no bench {unknown[0]!r}; there are {', '.join(NAMES)}", file=sys.stderr)
        return 2
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    for name in names:
        print(f"== {name}", flush=True)
        if name == "diagnosis" and cores:  # counts, no times to compare: on every core there is
            os.sched_setaffinity(0, cores)
        elif cores:
            os.sched_setaffinity(0, {max(cores)})
        import_module(f"bench.{name}").run(*([options or OPTIONS[name]] if name in OPTIONS else []))
    return 0


if __name__ == "__main__":
    sys.exit(main())

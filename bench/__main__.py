"""`python -m bench [NAME …] [OPTIONS]`: table1, rivals, diagnosis; all of them without a name.

Options are those of `rivals` or `diagnosis`.
"""

from __future__ import annotations

import os
import sys

# Before numpy is loaded: one core, so that times mean something and don't depend on what else runs.
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

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

"""What holds for every test: how many threads a process takes, how property tests run, and what is left to campaigns.

Here, above all tests: these settings have to be made before the first of them is imported.
"""

from __future__ import annotations

import os
import sys

import pytest
from hypothesis import HealthCheck, settings

pytest_plugins = ["tests.harness.paced_time"]

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # several test processes share the processors

# Test processes, and the hundreds that tests start, load what was compiled once, even where a shell says otherwise.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The machine is shared: how long an example takes says nothing about the code.
settings.register_profile("shared-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared-machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--campaigns", action="store_true", help="run the tests marked `campaign`, too")
    parser.addoption("--postgresql", action="store_true", help="services keep their data in PostgreSQL, not in SQLite")
    parser.addoption("--late-answers", type=int, metavar="SEED", help="services answer browsers late and in pieces")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what only a campaign runs, and what is SQLite's own on PostgreSQL; count it as deselected."""
    without = [] if config.getoption("--campaigns") else ["campaign"]
    without += ["sqlite"] if config.getoption("--postgresql") else []
    left_out = {item for item in items if any(item.get_closest_marker(name) for name in without)}
    if left_out:
        config.hook.pytest_deselected(items=list(left_out))
        items[:] = [item for item in items if item not in left_out]

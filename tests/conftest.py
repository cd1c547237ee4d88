"""What holds for every test: how many threads a process takes, how property tests run, and what is left to campaigns.

Here, above all tests: these settings have to be made before the first of them is imported.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.harness import made_once

pytest_plugins = ["tests.harness.paced_time"]

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # several test processes share the processors

# Test processes, and the hundreds that tests start, load what was compiled once, even where a shell says otherwise.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
gc.disable()  # until all tests are collected: nothing of it is garbage, and looking takes a third of the time

SLOW = (
    "tests/api/centre/",
    "tests/api/cohort/",
    "tests/api/outbox/",
    *(f"tests/api/test_{name}.py" for name in ("adaptive_worker", "doctor", "languages", "migrations", "schemas")),
    *(f"tests/api/test_{name}.py" for name in ("languages", "tracking_worker", "why", "worker")),
    *(f"tests/examples/test_ilc_{name}.py" for name in ("controller", "moving_joint")),
    *(f"tests/hardware_sim/test_{name}.py" for name in ("arm_records", "changing_patient", "hidden_records")),
    *(
        f"tests/identify/test_{name}.py"
        for name in (
            "carrying",
            "examples",
            "invariance",
            "moving_joint",
            "renewed_curve",
            "same_record",
            "tracked_states",
            "tracking",
            "uncertainty",
        )
    ),
    *(
        f"tests/rig/test_{name}.py"
        for name in ("adaptive", "angle_recording", "angle_run", "damaged", "lsl_live", "plausibility", "run")
    ),
    "tests/stimrig/test_stimrig.py",
)
"""Folders and files that take seconds in all, though few of their tests do: marked `slow`, so not in `make check`."""

# The machine is shared: how long an example takes says nothing about the code.
settings.register_profile("shared-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared-machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--campaigns", action="store_true", help="run the tests marked `campaign`, too")
    parser.addoption("--postgresql", action="store_true", help="services keep their data in PostgreSQL, not in SQLite")
    parser.addoption("--late-answers", type=int, metavar="SEED", help="services answer browsers late and in pieces")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        gc.enable()  # it collects nothing itself


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what is slow; count what only a campaign runs, and SQLite's own on PostgreSQL, as deselected."""
    for item in items:
        if item.nodeid.startswith(SLOW):
            item.add_marker("slow")
    without = [] if config.getoption("--campaigns") else ["campaign"]
    without += ["sqlite"] if config.getoption("--postgresql") else []
    left_out = {item for item in items if any(item.get_closest_marker(name) for name in without)}
    if left_out:
        config.hook.pytest_deselected(items=list(left_out))
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture(scope="session", autouse=True)
def kept_for_all_processes(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> None:
    """Beside the folders of the processes, whose parent is this run's own."""
    base = tmp_path_factory.getbasetemp()
    folder: Path = (base.parent if hasattr(request.config, "workerinput") else base) / "made-once"
    folder.mkdir(exist_ok=True)
    made_once.folder = folder


def pytest_collection_finish() -> None:
    """What was collected stays: no garbage collection looks at it again, nor copies it into a process's child."""
    gc.freeze()
    gc.enable()

"""Settings of all tests: threads of linear algebra, the profile of property tests, and the marker `campaign`."""

from __future__ import annotations

import os

import pytest
from hypothesis import HealthCheck, settings

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy is imported: several test processes share the processors

# On a shared machine the time of an example says nothing about the code.
settings.register_profile("shared-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared-machine")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect `campaign` unless the expression of markers names it."""
    if "campaign" in config.option.markexpr:
        return
    deselected = {item for item in items if item.get_closest_marker("campaign")}
    if deselected:
        config.hook.pytest_deselected(items=list(deselected))
        items[:] = [item for item in items if item not in deselected]

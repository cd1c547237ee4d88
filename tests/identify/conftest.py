"""Diagnoses in these tests try effects one after another: the run has a process for each processor already."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from stimrig.identify.diagnosis import side_by_side


@pytest.fixture(scope="package", autouse=True)
def one_process() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(side_by_side, "WORKERS", 1)
        yield

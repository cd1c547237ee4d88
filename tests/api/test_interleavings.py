"""A few runs of `tests.api.interleavings`: people, a controller and a busy database at odds."""

from __future__ import annotations

from random import Random

import pytest

from tests.api.conftest import Service
from tests.api.interleavings import one


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_decided_on_what_its_maker_has_not_seen(service: Service, seed: int) -> None:
    run = one(service, Random(seed))
    assert run.wrong == [] and run.decided > 0

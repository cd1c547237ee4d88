"""A small part of the soak: `python -m bench.soak --minutes 60` is the whole, docs/results/soak.md has its figures."""

from __future__ import annotations

import os

import pytest

from tests.harness.soak import soak

MINUTES = float(os.environ.get("STIMRIG_SOAK_MINUTES", "2"))


@pytest.mark.wire
@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_no_sample_is_lost_while_fits_run_beside():
    found = soak(MINUTES, every_minutes=min(MINUTES, 1.0), patient=True)
    assert found["lost_samples"] == 0
    assert found["completed"] == found["tests"] >= 1, found
    assert found["samples"] >= 60_000
    assert found["fits_beside"] >= 1
    assert found["alignment_error_ms"] < 1.0
    assert found["pulses_felt"] == found["pulses_sent"]
    assert found["state"] == "ready"

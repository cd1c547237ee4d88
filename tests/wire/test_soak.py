"""Half a minute of the soak: `make soak` plays an hour, docs/results/soak.md has its figures."""

from __future__ import annotations

import pytest

from tests.harness.soak import soak

SEGMENTS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
    {"name": "prbs", "sequence": "prbs", "settings": {"bits": 6, "clock_pulses": 2}},
    {"name": "ramp", "sequence": "ramp", "settings": {"up_s": 3.0, "down_s": 3.0}},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
]
"""A test of 11 s; the second one runs beside fits of the first."""


@pytest.mark.wire
@pytest.mark.campaign
def test_no_sample_is_lost_while_fits_run_beside():
    found = soak(0.5, every_minutes=0.25, patient=True, segments=SEGMENTS)
    assert found["lost_samples"] == 0
    assert found["completed"] == found["tests"] == 2, found
    assert found["samples"] >= 30_000
    assert found["fits_beside"] >= 1
    assert found["alignment_error_ms"] < 1.0
    assert found["pulses_felt"] == found["pulses_sent"]
    assert found["state"] == "ready"

"""What the adviser's worker keeps between its jobs, and which models it takes."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.api.errors import ApiError
from stimrig.api.jobs import adaptive as verbs
from stimrig.api.jobs.pool import Pool
from tests.harness.adaptive import PULSE_RATE_HZ, recorded, sigmoid

pytestmark = pytest.mark.slow
BEGIN: dict[str, Any] = {
    "target": {"curve_percent": 4.0, "step_percent": 4.0}, "playable_s": 44.0, "max_torque_time_nm_s": 360.0,
    "largest_us": 300.0, "pulse_rate_hz": PULSE_RATE_HZ,
}  # fmt: skip


def test_a_model_that_cannot_be_read_here_keeps_nobody_from_a_test() -> None:
    widths = np.array([0.0] * 20 + [7.5 * k for k in range(1, 41)] + [300.0] * 12 + [0.0] * 36 + [150.0] * 80)
    noise_nm = 0.05 * np.random.default_rng(3).standard_normal(4000)
    record = recorded(sigmoid(74), widths, ["opening"] * widths.size, noise_nm)
    readable = identify.fit(record, recruitment="near-sigmoid").to_json()
    assert verbs.known(["{}", readable]).model.to_json() == readable
    assert verbs.known([readable, "{}"]) is verbs.known(["no JSON"]) is None  # an older one is not the last one


def test_a_worker_that_died_or_a_begin_that_failed_leaves_no_test_to_advise() -> None:
    async def asked() -> None:
        adviser = Pool(1)
        try:
            await adviser.submit("adaptive_begin", **BEGIN).result
            with pytest.raises(ApiError):
                await adviser.submit("adaptive_begin", **BEGIN, models=7).result
            with pytest.raises(ApiError, match="started again during the test"):
                await adviser.submit("adaptive_advise").result
            assert await adviser.submit("adaptive_begin", **BEGIN).result == {}
            adviser.workers[0].end()
            with pytest.raises(ApiError, match="started again during the test"):
                await adviser.submit("adaptive_advise").result
        finally:
            await adviser.close()

    asyncio.run(asked())

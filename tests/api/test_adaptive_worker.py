"""What the adviser's worker makes of live samples: their times, their record, and decisions that keep their word."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.api.errors import ApiError
from stimrig.api.jobs import adaptive as verbs
from stimrig.api.jobs.pool import Pool
from tests.harness.adaptive import PULSE_RATE_HZ, Muscle, recorded, sigmoid

pytestmark = pytest.mark.slow

HOW: dict[str, Any] = {
    "target": {"curve_percent": 4.0, "step_percent": 4.0},
    "playable_s": 44.0,
    "max_torque_time_nm_s": 360.0,
    "largest_us": 300.0,
    "pulse_rate_hz": PULSE_RATE_HZ,
}
ZERO_S = 500.0
OPENING = [0.0] * 20 + [7.5 * k for k in range(1, 41)] + [300.0] * 12 + [0.0] * 36


def quiet(*_: Any) -> None:
    """Progress that nobody sees."""


class Cell:
    """A load cell whose samples take a while to arrive, some of them much longer."""

    def __init__(self, muscle: Muscle, seed: int, rate_hz: float = 1600.0, way_s: float = 0.0024) -> None:
        self.muscle, self.rate_hz, self.way_s, self.seed = muscle, rate_hz, way_s, seed
        self.sent = 0

    def news(self, widths: list[float], until_s: float, lost: tuple[int, int] = (0, 0)) -> np.ndarray:
        """The samples that are new, as the rig sends them."""
        rng = np.random.default_rng([self.seed, 7])
        torque = self.muscle.torque(np.array(widths), self.rate_hz)
        noise = 0.01 * np.random.default_rng(self.seed).standard_normal(200_000)[: torque.size]
        late = self.way_s + rng.exponential(0.0005, 200_000)[: torque.size]
        late[::400] += 0.08
        numbers = np.arange(self.sent, int(until_s * self.rate_hz))
        numbers = numbers[(numbers < lost[0]) | (numbers >= lost[1])]
        self.sent = int(until_s * self.rate_hz)
        found = np.zeros(numbers.size, verbs.SAMPLE)
        found["host_time_s"] = ZERO_S + numbers / self.rate_hz + late[numbers]
        found["counter"], found["torque_nm"], found["sync"] = numbers + 4000, (torque + noise)[numbers], 255
        return found


def felt(widths: list[float], until: int, not_sent: Sequence[int] = (), late_s: dict[int, float] | None = None) -> Any:
    """What became of the pulses before one, as live events tell it."""
    index = [i for i in range(until) if widths[i] > 0]
    written = [None if i in not_sent else i / PULSE_RATE_HZ + (late_s or {}).get(i, 0.0) for i in index]
    return {
        "index": index,
        "pulse_width_us": [0.0 if i in not_sent else widths[i] for i in index],
        "written_time_s": written,
        "acknowledged_time_s": [None if t is None else t + 0.001 for t in written],
        "status": [2 if i in not_sent else 0 for i in index],
    }


def test_times_are_those_of_the_samples_that_waited_nowhere() -> None:
    news = Cell(sigmoid(71), 1).news([0.0] * 120, 3.0)
    time_s = verbs.sample_times(news["host_time_s"] - ZERO_S, news["counter"])
    assert np.abs(time_s - 0.0024 - np.arange(4800) / 1600.0).max() < 0.0003


def test_lost_samples_and_none_move_nothing() -> None:
    muscle, widths = sigmoid(72), OPENING
    segments = [("opening", 0, len(widths))]
    records = []
    for lost in ((0, 0), (1600, 1900)):
        news = Cell(muscle, 2).news(widths, 2.5, lost)
        news["torque_nm"][100] = np.nan
        records.append(verbs.record_of(news, ZERO_S, felt(widths, 100), widths, segments, PULSE_RATE_HZ))
    whole, holed = records
    assert whole.time_s.size - holed.time_s.size == pytest.approx(300 / 8, abs=2)
    kept = np.isin(whole.time_s, holed.time_s)
    assert np.abs(np.interp(holed.time_s, whole.time_s[kept], whole.torque_nm[kept]) - holed.torque_nm).max() < 0.05
    assert np.array_equal(holed.pulses.width_us, widths[: holed.pulses.width_us.size])
    assert holed.pulses.width_us.size >= 2.5 * PULSE_RATE_HZ - 1 and not holed.doubted[holed.time_s < 2.4].any()


def test_a_late_pulse_is_late_in_the_record() -> None:
    news = Cell(sigmoid(72), 2).news(OPENING, 2.5)
    told = felt(OPENING, 100, late_s={30: 0.004})
    record = verbs.record_of(news, ZERO_S, told, OPENING, [("opening", 0, len(OPENING))], 40.0)
    late = (record.time_s >= 30 / 40.0) & (record.time_s < 31 / 40.0)
    assert late.sum() == verbs.BINS
    assert np.allclose(record.late_s, np.where(late, 0.004, 0.0))
    assert record.pulses.late_s[30] == pytest.approx(0.004)


def test_a_pause_is_a_gap_in_the_record_and_what_is_not_told_yet_is_doubted() -> None:
    """The muscle felt nothing in it, whatever was planned; the newest pulses may still be on their way."""
    news, gap = Cell(sigmoid(72), 2).news(OPENING, 2.0), range(40, 56)
    record = verbs.record_of(news, ZERO_S, felt(OPENING, 70, gap), OPENING, [("opening", 0, len(OPENING))], 40.0)
    inside = (record.time_s >= 40 / 40.0) & (record.time_s < 56 / 40.0)
    after = (record.time_s > 56 / 40.0) & (record.time_s < 72 / 40.0)
    assert not record.pulse_width_us[inside].any() and record.pulse_width_us[after].all()
    assert record.pulses.lost[40:56].all()
    assert np.array_equal(record.doubted, record.time_s >= 70 / 40.0 + record.pulses.time_s[0])


def test_a_sync_line_tells_when_a_pulse_was_felt_whose_acknowledgement_was_read_late() -> None:
    """As where the computer stood still between a pulse and its acknowledgement."""
    news = Cell(sigmoid(72), 2, way_s=0.0).news(OPENING, 2.5)
    told = felt(OPENING, 100)
    told["acknowledged_time_s"][30] += 0.6
    rising = {round((t + 0.0005) * 1600) + 1 for t in told["written_time_s"]}
    for line, doubts in ((False, True), (True, False)):
        if line:
            news["sync"] = np.isin(np.arange(news.size), list(rising))
        record = verbs.record_of(news, ZERO_S, told, OPENING, [("opening", 0, len(OPENING))], 40.0)
        assert (record.doubted is not None and bool(record.doubted.any())) is doubts


def test_a_slow_cell_keeps_its_samples() -> None:
    time_s = np.arange(300) / 100.0
    assert verbs.means(time_s, time_s, 5 * PULSE_RATE_HZ)[0].size == 300


def test_a_model_that_cannot_be_read_here_keeps_nobody_from_a_test() -> None:
    widths = np.array([*OPENING, *[150.0] * 80])
    noise_nm = 0.05 * np.random.default_rng(3).standard_normal(4000)
    record = recorded(sigmoid(74), widths, ["opening"] * widths.size, noise_nm)
    readable = identify.fit(record, recruitment="near-sigmoid").to_json()
    assert verbs.known(["{}", readable]).model.to_json() == readable
    assert verbs.known([readable, "{}"]) is verbs.known(["no JSON"]) is None  # an older one is not the last one


def test_a_worker_that_died_or_a_begin_that_failed_leaves_no_test_to_advise() -> None:
    async def asked() -> None:
        adviser = Pool(1)
        try:
            await adviser.submit("adaptive_begin", **HOW).result
            with pytest.raises(ApiError):
                await adviser.submit("adaptive_begin", **HOW, models=7).result
            with pytest.raises(ApiError, match="started again during the test"):
                await adviser.submit("adaptive_advise").result
            assert await adviser.submit("adaptive_begin", **HOW).result == {}
            adviser.workers[0].end()
            with pytest.raises(ApiError, match="started again during the test"):
                await adviser.submit("adaptive_advise").result
            assert await adviser.submit("adaptive_begin", **HOW).result == {}
        finally:
            await adviser.close()

    asyncio.run(asked())

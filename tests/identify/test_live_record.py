"""The record of live samples: times of samples that arrive late, pulses as they were sent, gaps and doubts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from stimrig.identify.records.live import BINS, SAMPLE, bin_means, live_record, sample_times
from stimrig.identify.records.record import Record
from tests.harness.adaptive import PULSE_RATE_HZ, sigmoid

pytestmark = pytest.mark.slow
ZERO_S = 500.0
OPENING = [0.0] * 20 + [7.5 * k for k in range(1, 41)] + [300.0] * 12 + [0.0] * 36


def arrived(widths: list[float], until_s: float, lost: tuple[int, int] = (0, 0), way_s: float = 0.0024) -> np.ndarray:
    """What a load cell's samples are to the rig: each takes a while to arrive, some of them much longer."""
    rate_hz, rng = 1600.0, np.random.default_rng(7)
    torque = sigmoid(72).torque(np.array(widths), rate_hz)
    torque = torque + 0.01 * rng.standard_normal(torque.size)
    late = way_s + rng.exponential(0.0005, torque.size)
    late[::400] += 0.08
    numbers = np.arange(int(until_s * rate_hz))
    numbers = numbers[(numbers < lost[0]) | (numbers >= lost[1])]
    rows = np.zeros(numbers.size, SAMPLE)
    rows["host_time_s"], rows["counter"] = ZERO_S + numbers / rate_hz + late[numbers], numbers + 4000
    rows["torque_nm"], rows["sync"] = torque[numbers], 255
    return rows


def outcomes(until: int, not_sent: Sequence[int] = (), late_s: dict[int, float] | None = None) -> dict[str, list[Any]]:
    """Outcomes of the opening's pulses before one, as live events have them."""
    index = [i for i in range(until) if OPENING[i] > 0]
    written = [None if i in not_sent else i / PULSE_RATE_HZ + (late_s or {}).get(i, 0.0) for i in index]
    return {
        "index": index,
        "pulse_width_us": [0.0 if i in not_sent else OPENING[i] for i in index],
        "written_time_s": written,
        "acknowledged_time_s": [None if t is None else t + 0.001 for t in written],
        "status": [2 if i in not_sent else 0 for i in index],
    }


def record_of(rows: np.ndarray, sent: dict[str, list[Any]]) -> Record:
    record = live_record(rows, ZERO_S, sent, OPENING, [("opening", 0, len(OPENING))], PULSE_RATE_HZ)
    assert record is not None
    return record


def test_times_are_those_of_the_samples_that_waited_nowhere() -> None:
    rows = arrived([0.0] * 120, 3.0)
    time_s = sample_times(rows["host_time_s"] - ZERO_S, rows["counter"])
    assert np.abs(time_s - 0.0024 - np.arange(4800) / 1600.0).max() < 0.0003


def test_lost_samples_and_samples_without_a_number_move_no_other() -> None:
    records = []
    for lost in ((0, 0), (1600, 1900)):
        rows = arrived(OPENING, 2.5, lost)
        rows["torque_nm"][100] = np.nan
        records.append(record_of(rows, outcomes(100)))
    whole, holed = records
    assert whole.time_s.size - holed.time_s.size == pytest.approx(300 / 8, abs=2)
    kept = np.isin(whole.time_s, holed.time_s)
    assert np.abs(np.interp(holed.time_s, whole.time_s[kept], whole.torque_nm[kept]) - holed.torque_nm).max() < 0.05
    assert np.array_equal(holed.pulses.width_us, OPENING[: holed.pulses.width_us.size])
    assert holed.pulses.width_us.size >= 2.5 * PULSE_RATE_HZ - 1 and not holed.doubted[holed.time_s < 2.4].any()


def test_a_late_pulse_is_late_in_the_record() -> None:
    record = record_of(arrived(OPENING, 2.5), outcomes(100, late_s={30: 0.004}))
    late = (record.time_s >= 30 / 40.0) & (record.time_s < 31 / 40.0)
    assert late.sum() == BINS and np.allclose(record.late_s, np.where(late, 0.004, 0.0))
    assert record.pulses.late_s[30] == pytest.approx(0.004)


def test_a_pause_is_a_gap_and_pulses_of_unknown_outcome_are_doubted() -> None:
    """The muscle felt nothing in a pause, whatever was planned; the newest pulses may still be on their way."""
    record = record_of(arrived(OPENING, 2.0), outcomes(70, range(40, 56)))
    inside = (record.time_s >= 40 / 40.0) & (record.time_s < 56 / 40.0)
    after = (record.time_s > 56 / 40.0) & (record.time_s < 72 / 40.0)
    assert not record.pulse_width_us[inside].any() and record.pulse_width_us[after].all()
    assert record.pulses.lost[40:56].all()
    assert np.array_equal(record.doubted, record.time_s >= 70 / 40.0 + record.pulses.time_s[0])


@pytest.mark.parametrize("line", [False, True])
def test_a_sync_line_says_when_a_pulse_with_a_late_acknowledgement_was_felt(line: bool) -> None:
    """As where the computer stood still between a pulse and its acknowledgement."""
    rows, sent = arrived(OPENING, 2.5, way_s=0.0), outcomes(100)
    sent["acknowledged_time_s"][30] += 0.6
    if line:
        rising = [round((t + 0.0005) * 1600) + 1 for t in sent["written_time_s"]]
        rows["sync"] = np.isin(np.arange(rows.size), rising)
    doubted = record_of(rows, sent).doubted
    assert (doubted is not None and bool(doubted.any())) is not line


def test_a_slow_cell_keeps_its_samples() -> None:
    time_s = np.arange(300) / 100.0
    assert bin_means(time_s, time_s, 5 * PULSE_RATE_HZ)[0].size == 300

"""What the service makes of the rig's numbers: bins for pages."""

from __future__ import annotations

from base64 import b64encode
from math import nan

import pytest

from stimrig.api.sessions.live import frame_of
from stimrig.identify.records import live
from stimrig.rig.messages import TORQUE_ROW, LiveEvent, PulseOutcomes
from stimrig.rig.signals import SAMPLE

ZERO_S = 50.0


def event(rows: list[tuple[float, float]], test_id: str | None = "T1") -> LiveEvent:
    """An event of samples, each with its time on the test's clock and its torque."""
    packed = [TORQUE_ROW.pack(ZERO_S + at_s, nan, nm, k, 255) for k, (at_s, nm) in enumerate(rows)]
    return LiveEvent(
        test_id=test_id, segment="prbs", elapsed_s=1.0, duration_s=9.0, torque_age_s=0.0, lost_samples=0,
        dropped_pulses=0, zero_s=ZERO_S, pulse_rate_hz=40.0, torque=b64encode(b"".join(packed)).decode(),
        outcomes=PulseOutcomes(
            index=[4, 5], pulse_width_us=[200.0, 0.0], written_time_s=[0.1, None], acknowledged_time_s=[0.101, None],
            status=[0, 1],
        ),
    )  # fmt: skip


def test_a_row_is_a_sample_as_the_rig_holds_it() -> None:
    assert SAMPLE == live.SAMPLE and TORQUE_ROW.size == SAMPLE.itemsize


def test_pages_get_the_lowest_and_highest_torque_of_each_bin_and_the_pulses() -> None:
    frame = frame_of(event([(0.501, 1.0), (0.504, 3.0), (0.509, 2.0), (0.511, nan), (0.515, -1.0), (0.525, nan)]))
    assert (frame.time_s, frame.torque_min_nm) == ([0.5, 0.51, 0.52], [1.0, -1.0, 0.0])
    assert frame.torque_max_nm == [3.0, 0.0, 0.0]
    assert (frame.pulse_time_s, frame.pulse_width_us) == ([0.1, 0.125], [200.0, 0.0])


@pytest.mark.parametrize(("test_id", "shown"), [("T1", [-0.5, 0.5]), (None, [-40.0, -0.5, 0.5, 3.0])])
def test_what_was_measured_far_from_the_test_is_not_drawn_in_it(test_id: str | None, shown: list[float]) -> None:
    assert frame_of(event([(-40.0, 1.0), (-0.495, 1.0), (0.505, 1.0), (3.0, 1.0)], test_id)).time_s == shown

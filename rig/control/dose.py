"""The dose of a test whose process died, from its journal's own lines: never less than what was felt."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import intended
from stimrig.rig.acquire.torque_time import TorqueTime
from stimrig.rig.assembly import Recording
from stimrig.rig.journal import JournalContents, Kind
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.signals import PulseStatus

MAY_BE_FELT = PulseStatus.ACKNOWLEDGED, PulseStatus.UNACKNOWLEDGED, PulseStatus.DEVICE_ERROR
REST_S = 0.1
"""Before the first pulse: what torque is rest."""


def of_recording(recording: Recording, contents: JournalContents, lost_s: float) -> dict[str, Any]:
    """Part of a finished test's summary.

    Parameters
    ----------
    lost_s
        Rig seconds before the test's end of which nothing may stand in the journal, as the computer lost its power:
        what was planned for so long counts, too.
    """
    columns, rate_hz = recording.columns, recording.attributes["pulse_rate_hz"]
    status, n = columns["pulses/status"], len(columns["pulses/status"])
    felt = np.isin(status, MAY_BE_FELT)
    widths_us, currents_ma = columns["pulses/sent_pulse_width_us"][felt], columns["pulses/current_ma"][felt]
    widest_us = _most(columns["pulses/pulse_width_us"], widths_us, HARD_LIMITS["pulse_width_us"].hi)
    highest_ma = _most(np.array([recording.attributes["current_ma"]]), currents_ma, HARD_LIMITS["current_ma"].hi)
    widths_us = np.where(widths_us > 0, widths_us, widest_us)  # of a pulse whose width is lost
    currents_ma = np.where(currents_ma > 0, currents_ma, highest_ma)
    header = contents.first_json(Kind.HEADER)  # None: it is lost
    planned_us = np.empty(0) if header is None else intended.planned(contents, header, [])[0]
    unseen_us = planned_us[n : n + int(np.ceil(lost_s * rate_hz))]
    doubtful = int(np.sum(status == PulseStatus.UNACKNOWLEDGED)) + int(np.sum(unseen_us > 0))
    played_s = max([n / rate_hz if felt.any() else 0.0, *columns["segments/end_s"].tolist()])
    return {
        "duration_s": played_s + len(unseen_us) / rate_hz,
        "pulses": int(felt.sum()) + int(np.sum(unseen_us > 0)),
        "dropped_pulses": int(np.sum(status == PulseStatus.DROPPED)),
        "charge_uc": float(np.sum(widths_us * currents_ma) + np.sum(unseen_us) * highest_ma) * 1e-3,
        **_of_torque(columns["torque/time_s"], columns["torque/torque_nm"], columns["pulses/planned_time_s"][felt]),
        "dose_is_bound": doubtful > 0,
        "doubtful_pulses": doubtful,
    }


def warnings(dose: dict[str, Any]) -> list[str]:
    """A sentence if the true dose may be lower."""
    if not dose.get("dose_is_bound"):
        return []
    return [
        f"dose: of {dose['doubtful_pulses']} pulses it is not known whether they were felt; they are counted, so the "
        "true dose may be lower"
    ]


def _most(one: NDArray[Any], other: NDArray[Any], unknown: float) -> float:
    """The largest number of both; `unknown` where there is none above 0."""
    return max((float(value) for value in (*one, *other) if value > 0), default=unknown)


def _of_torque(time_s: NDArray[Any], torque_nm: NDArray[Any], pulses_s: NDArray[Any]) -> dict[str, float]:
    """Torque-time since the first pulse, and the peak."""
    known = np.isfinite(torque_nm)
    time_s, torque_nm = time_s[known], torque_nm[known]
    peak_nm = float(np.abs(torque_nm).max()) if len(torque_nm) else 0.0
    if not len(pulses_s):
        return {"torque_time_nms": 0.0, "torque_peak_nm": peak_nm}
    first_s = float(pulses_s[0])
    resting = torque_nm[(time_s > first_s - REST_S) & (time_s <= first_s)]
    summed = TorqueTime()
    summed.begin(float(np.median(resting)) if len(resting) else 0.0, first_s)
    for at_s, value_nm in zip(time_s[time_s > first_s], torque_nm[time_s > first_s], strict=True):
        summed.add(float(at_s), float(value_nm))
    return {"torque_time_nms": summed.nms, "torque_peak_nm": peak_nm}

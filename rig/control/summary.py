"""What a finished test's event says of its recording: counts, warnings, and the dose where its process died.

That dose is from the journal's own lines: never less than what was felt.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import assembly
from stimrig.rig.acquire.receiver import TorqueTime
from stimrig.rig.assembly import Recording
from stimrig.rig.control.live import finite
from stimrig.rig.journal import JournalContents, Kind
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.signals import PulseStatus

MAY_BE_FELT = PulseStatus.ACKNOWLEDGED, PulseStatus.UNACKNOWLEDGED, PulseStatus.DEVICE_ERROR
REST_S = 0.1
"""Before the first pulse: what torque is rest."""
DOUBTFUL_ALIGNMENT_MS = 5.0
DOUBTFUL_RATE = 0.02
"""Beyond these a recording's times are uncertain, and its finished event says so. A larger rate error is a fault."""
ROUNDED_US = 1.0
"""A width that is lower than planned by more was not only rounded to the device's step."""


def recovered_dose(recording: Recording, contents: JournalContents, lost_s: float) -> dict[str, Any]:
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
    planned_us = np.empty(0) if header is None else assembly.planned_pulses(contents, header, [])[0]
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


def _most(one: NDArray[Any], other: NDArray[Any], unknown: float) -> float:
    """The largest number of both; `unknown` where there is none above 0."""
    return max((float(value) for value in (*one, *other) if value > 0), default=unknown)


def _of_torque(time_s: NDArray[Any], torque_nm: NDArray[Any], pulses_s: NDArray[Any]) -> dict[str, float]:
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


def summary_of(recording: Recording, counted: dict[str, Any]) -> dict[str, Any]:
    """Part of a finished test's summary; `counted`: what is known without the recording."""
    alignment, dose = recording.alignment, []
    if counted.get("dose_is_bound"):
        dose.append(
            f"dose: of {counted['doubtful_pulses']} pulses it is not known whether they were felt; they are counted, "
            "so the true dose may be lower"
        )
    return {
        **({"angle": counted.get("angle", {}) | _of_joint(recording)} if recording.angle else {}),
        "samples": len(recording.columns["torque/time_s"]),
        "sample_rate_hz": recording.attributes["sample_rate_measured_hz"],
        "alignment": {**asdict(alignment), "error_ms": finite(alignment.error_ms)},
        "warnings": [*warnings(recording), *dose],
    }


def _of_joint(recording: Recording) -> dict[str, Any]:
    angle_rad, error_ms = recording.columns["angle/angle_rad"], recording.angle["error_ms"]
    return {
        "samples": len(angle_rad),
        "range_rad": [float(angle_rad.min()), float(angle_rad.max())] if len(angle_rad) else None,
        "method": recording.angle["method"],
        "error_ms": finite(error_ms),
    }


def warnings(recording: Recording) -> list[str]:
    """Warnings before a model is fitted to it, one sentence each; empty if there are none."""
    alignment, attributes = recording.alignment, recording.attributes
    found = [*_disturbed_line(recording), *_of_sensor(recording)]
    if attributes["journal_note"]:
        found.append(f"journal: {attributes['journal_note']}")
    nominal_hz, measured_hz = attributes["sample_rate_hz"], attributes["sample_rate_measured_hz"]
    if not len(recording.columns["torque/time_s"]):
        return found
    torque_nm = recording.columns["torque/torque_nm"]
    if np.all(torque_nm == torque_nm[0]):
        found.append(
            f"load cell: its value stayed at exactly {torque_nm[0]:.3f} N·m in the whole test; it may be stuck"
        )
    if not (alignment.error_ms <= DOUBTFUL_ALIGNMENT_MS):
        error = "unknown" if alignment.error_ms != alignment.error_ms else f"{alignment.error_ms:.1f} ms"
        found.append(
            f"torque and pulses: the error of their alignment is {error} (usual: up to {DOUBTFUL_ALIGNMENT_MS:g} ms), "
            "because the computer or the bus was blocked; delays in a model of this recording may be wrong"
        )
    if nominal_hz > 0 and not (abs(measured_hz / nominal_hz - 1) <= DOUBTFUL_RATE):
        found.append(
            f"load cell: {measured_hz:.0f} samples/s arrived, the rig file says {nominal_hz:g}: times in this "
            "recording may be wrong"
        )
    return found


def _of_sensor(recording: Recording) -> list[str]:
    """Warnings about an angle sensor that failed in a test that did not need it, or whose times are uncertain."""
    found = [
        f"{event['reason']}; the angle in this recording may be wrong or missing"
        for event in recording.events
        if event.get("event") == "angle_trouble"
    ]
    if not recording.angle or not len(recording.columns["angle/time_s"]):
        return found
    error_ms = recording.angle["error_ms"]
    if not (error_ms <= DOUBTFUL_ALIGNMENT_MS):
        error = "unknown" if error_ms != error_ms else f"{error_ms:.1f} ms"
        found.append(f"angle and torque: the error of their alignment is {error}; a model of a movement may be wrong")
    return found


def _disturbed_line(recording: Recording) -> list[str]:
    """Warnings about late acknowledgements, acknowledgements of what was not sent, dropped pulses and what followed."""
    named = [event.get("event") for event in recording.events]
    late_s = [event["delay_s"] for event in recording.events if event.get("event") == "late_ack"]
    found = []
    if unasked := named.count("unasked_ack"):
        found.append(
            f"stimulator: it acknowledged {unasked} pulses that were not sent; they may have been felt and are not in "
            "this recording"
        )
    if late_s:
        found.append(
            f"stimulator: {len(late_s)} acknowledgements came late, up to {max(late_s) * 1e3:.0f} ms after the pulse "
            f"was sent; these pulses may have been felt that late; {named.count('dropped')} pulses that came due "
            "meanwhile were dropped"
        )
    planned_us, sent_us = (recording.columns[f"pulses/{name}_width_us"] for name in ("pulse", "sent_pulse"))
    if weaker := int(np.count_nonzero(planned_us - sent_us > ROUNDED_US)):
        found.append(
            f"stimulator: {weaker} pulses were narrower than planned, since after dropped pulses the width climbs back "
            "no faster than its limit"
        )
    return found

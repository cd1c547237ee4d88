"""NWB 2: a file a record. Torque is an acquisition, pulses are a stimulus, segments are intervals.

Every series has times, not a rate: a recording has gaps, and its times are exact. NWB wants the start of a session:
where that is not to be told `UNDATED` stands for it, and the description says so.
"""

from __future__ import annotations

import io
from datetime import UTC, datetime
from importlib import import_module
from typing import Any

import h5py
import numpy as np

from stimrig.api.cohort.export import Put, Who
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.exchange.outward import _figures
from stimrig.api.exchange.outward.parquet import COLUMNS, STATUS, record_row
from stimrig.api.version import software_version
from stimrig.identify.records.record import HELD_OUT

NAME: str = "nwb"
NEEDS = ("pynwb",)
UNDATED = datetime(1980, 1, 1, tzinfo=UTC)
SERIES = {
    "pulse_width_in_force": ("pulse_width_us", "seconds", 1e-6),
    "lateness": ("late_s", "seconds", 1.0),
    "doubted": ("doubted", "1", 1.0),
    "counter": ("counter", "1", 1.0),
    "sync": ("sync", "1", 1.0),
    "host_time": ("host_time_s", "seconds", 1.0),
}
"""Series on the times of the torque: the record's column, NWB's unit, and the factor to that unit."""
ANGLES = {"joint_angle": ("angle_rad", "radians"), "joint_velocity": ("velocity_rad_s", "radians/second")}
SAYS = {column.name: column.meaning.replace("null", "NaN") for column in COLUMNS["samples"]}


def write(record: WholeRecord, who: Who, put: Put) -> dict[str, Any]:
    """The record's file; its row."""
    pynwb: Any = import_module("pynwb")  # its classes are made when it is loaded
    packed = io.BytesIO()
    with h5py.File(packed, "w") as file, pynwb.NWBHDF5IO(file=file, mode="w") as out:
        out.write(_file(record, who))
    with put(f"sub-{who.label}/sub-{who.label}_ses-{who.session}_{who.key}.nwb") as target:
        target.write(packed.getbuffer())
    return record_row(record, who)


def finish(_state: State, _put: Put) -> None:
    """Nothing is made of all files."""


def _file(record: WholeRecord, who: Who) -> Any:
    pynwb: Any = import_module("pynwb")  # its classes are made when it is loaded
    begun = datetime.fromisoformat(who.begun_utc) if who.begun_utc else UNDATED
    told = "" if who.begun_utc else f" The day is not told: {UNDATED.date()} stands for it."
    file = pynwb.NWBFile(
        session_description=f"Torque at a joint while a muscle is stimulated electrically.{told}",
        identifier=f"{who.record_id} {who.key}",
        session_start_time=begun,
        file_create_date=[begun],  # nothing tells when it was exported
        session_id=who.session,
        notes=_figures.metadata(record),
        keywords=["functional electrical stimulation", "torque", "muscle"],
        experiment_description=str(record.about.get("kind") or "test"),
        was_generated_by=[["stimrig", software_version()]],
        subject=pynwb.file.Subject(  # NWB wants an age: a range from 0 without an end says nothing
            subject_id=who.participant, species="Homo sapiens", sex="U", age="P0D/", description="known by code only"
        ),
    )
    for name, model in _figures.devices(record).items():
        file.create_device(name=name, description=model)
    _add_samples(file, record)
    _add_pulses(file, record)
    _add_segments(file, record)
    return file


def _series(name: str, data: Any, unit: str, times: Any, says: str, factor: float = 1.0) -> Any:
    pynwb: Any = import_module("pynwb")
    kept = pynwb.H5DataIO(data, compression="gzip", shuffle=True)
    return pynwb.TimeSeries(name=name, data=kept, unit=unit, conversion=factor, timestamps=times, description=says)


def _add_samples(file: Any, record: WholeRecord) -> None:
    columns = record.samples
    torque = _series("torque", columns["torque_nm"], "N*m", columns["time_s"], SAYS["torque_nm"])
    file.add_acquisition(torque)
    for name, (column, unit, factor) in SERIES.items():
        if column in columns:
            add = file.add_stimulus if name == "pulse_width_in_force" else file.add_acquisition
            add(_series(name, columns[column], unit, torque, SAYS[column], factor))
    own = record.angle.get("time_s")
    times = torque if own is None else own
    for name, (column, unit) in ANGLES.items():
        values = columns.get(column) if own is None else record.angle.get(column)
        if values is not None:
            file.add_acquisition(_series(name, values, unit, times, SAYS[column]))


def _add_pulses(file: Any, record: WholeRecord) -> None:
    """What was sent, at the times at which it was written; and all that is known of all pulses, as a table."""
    from pynwb.core import DynamicTable, VectorData

    pulses = record.pulses
    if not len(pulses.get("planned_time_s", ())):
        return
    if {"written_time_s", "sent_pulse_width_us"} <= pulses.keys():
        sent = np.isfinite(pulses["written_time_s"]) & (pulses["sent_pulse_width_us"] > 0)
        if sent.any():
            at, says = pulses["written_time_s"][sent], "width of a phase of each pulse that was written to the line"
            file.add_stimulus(_series("pulse_width", pulses["sent_pulse_width_us"][sent], "seconds", at, says, 1e-6))
    says = {column.name: f"{column.meaning.replace('null', 'NaN')} ({column.unit})" for column in COLUMNS["pulses"]}
    table: dict[str, Any] = {name: column for name, column in pulses.items() if name != "status"}
    if "status" in pulses:
        table["status"] = [STATUS[int(code)] if code in range(len(STATUS)) else "" for code in pulses["status"]]
    columns = [VectorData(name=name, data=values, description=says[name]) for name, values in table.items()]
    file.add_stimulus(DynamicTable(name="pulses", description="every planned pulse", columns=columns))


def _add_segments(file: Any, record: WholeRecord) -> None:
    from pynwb.epoch import TimeIntervals

    if not record.segments:
        return
    table = TimeIntervals(name="segments", description=f"parts of the test; {HELD_OUT} is held out from fits")
    table.add_column(name="segment", description="name of the part")
    table.add_column(name="held_out", description="whether it is never used to fit")
    for name, start_s, end_s in record.segments:
        table.add_row(start_time=start_s, stop_time=end_s, segment=name, held_out=name == HELD_OUT)
    file.add_time_intervals(table)

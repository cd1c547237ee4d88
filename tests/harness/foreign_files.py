"""Files as other tools write them: XDF of LabRecorder, written by its specification; a BIDS recording; NWB by pynwb."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pynwb import NWBHDF5IO, NWBFile, TimeSeries


@dataclass
class Stream:
    """A stream of an XDF file."""

    name: str
    kind: str
    rate_hz: float  # nominal; 0: irregular
    channels: Sequence[tuple[str, str]]  # label and unit
    time_s: Sequence[float]
    values: Any  # shape (N, C), or texts
    host: str = "lab"
    offsets: Sequence[tuple[float, float]] = field(default_factory=tuple)  # time of a measurement, offset


def _length(size: int) -> bytes:
    return b"\x01" + struct.pack("<B", size) if size < 256 else b"\x04" + struct.pack("<I", size)


def chunk(tag: int, body: bytes) -> bytes:
    return _length(len(body) + 2) + struct.pack("<H", tag) + body


def header_xml(stream: Stream, text: bool) -> str:
    labels = "".join(f"<channel><label>{a}</label><unit>{b}</unit></channel>" for a, b in stream.channels)
    return (
        f'<?xml version="1.0"?><info><name>{stream.name}</name><type>{stream.kind}</type>'
        f"<channel_count>{len(stream.channels)}</channel_count><nominal_srate>{stream.rate_hz}</nominal_srate>"
        f"<channel_format>{'string' if text else 'double64'}</channel_format><hostname>{stream.host}</hostname>"
        f"<desc><channels>{labels}</channels></desc></info>"
    )


def xdf(streams: Sequence[Stream], each: int = 200) -> bytes:
    """An XDF file: header, a chunk of so many samples at a time, offsets of clocks, footers."""
    found = b"XDF:" + chunk(1, b'<?xml version="1.0"?><info><version>1.0</version></info>')
    for number, stream in enumerate(streams, 1):
        text = bool(len(stream.values)) and isinstance(stream.values[0], str)
        found += chunk(2, struct.pack("<I", number) + header_xml(stream, text).encode())
        for first in range(0, len(stream.time_s), each):
            rows = range(first, min(first + each, len(stream.time_s)))
            body = struct.pack("<I", number) + b"\x04" + struct.pack("<I", len(rows))
            for row in rows:
                body += b"\x08" + struct.pack("<d", stream.time_s[row])
                if text:
                    content = stream.values[row].encode()
                    body += _length(len(content)) + content
                else:
                    body += struct.pack(f"<{len(stream.channels)}d", *np.atleast_1d(stream.values[row]))
            found += chunk(3, body)
        for at_s, offset_s in stream.offsets:
            found += chunk(4, struct.pack("<Idd", number, at_s, offset_s))
        foot = f"<info><sample_count>{len(stream.time_s)}</sample_count></info>"
        found += chunk(6, struct.pack("<I", number) + foot.encode())
    return found


def bids(folder: Path, columns: dict[str, np.ndarray], units: dict[str, str], rate_hz: float) -> Path:
    """A physio recording with its sidecar, and what lasts in an events file."""
    stem = folder / "sub-07_task-hold"
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    text = "".join("\t".join("n/a" if value != value else repr(value) for value in row) + "\n" for row in rows)
    path = stem.with_name(f"{stem.name}_physio.tsv.gz")
    path.write_bytes(gzip.compress(text.encode()))
    head: dict[str, Any] = {"SamplingFrequency": rate_hz, "StartTime": 0, "Columns": list(columns)}
    head |= {name: {"Description": name, "Units": unit} for name, unit in units.items()}
    stem.with_name(f"{stem.name}_physio.json").write_text(json.dumps(head))
    lines = ["onset\tduration\ttrial_type", "0\t10\tprbs", "10\t10\tvalidate", "3\t0\tclick"]
    stem.with_name(f"{stem.name}_events.tsv").write_text("\n".join(lines) + "\n")
    return path


def nwb(path: Path, time_s: np.ndarray, force: np.ndarray, pulses_s: np.ndarray, widths_us: np.ndarray) -> Path:
    """A dynamometer's NWB file: force of two channels as whole numbers, pulses in seconds, epochs of another name."""
    file = NWBFile("a dynamometer", "x-1", datetime(2025, 3, 4, 5, 6, tzinfo=UTC))
    counts = np.column_stack([np.round(force * 100), np.zeros(force.size)]).astype(np.int16)
    file.add_acquisition(
        TimeSeries(name="Dynamometer", data=counts, unit="newtons", conversion=0.01, rate=1 / float(time_s[1]))
    )
    file.add_acquisition(TimeSeries(name="Mystery", data=force, unit="a.u.", rate=1 / float(time_s[1])))
    file.add_stimulus(
        TimeSeries(name="Stim", data=widths_us, unit="seconds", conversion=1e-6, timestamps=pulses_s, description="p")
    )
    file.add_epoch_column(name="label", description="what")
    for name, start_s, stop_s in (("prbs", 0.0, 10.0), ("validate", 10.0, 20.0)):
        file.add_epoch(start_s, stop_s, label=name)
    with NWBHDF5IO(path, "w") as out:
        out.write(file)
    return path

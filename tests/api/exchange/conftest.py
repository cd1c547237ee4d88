"""Recordings that are hard to hand on, and each of them in every format, once for the room."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig.api.cli import main
from tests.harness.cohort_records import Session, write

FORMATS = ("parquet", "bids", "nwb", "fhir", "redcap", "mat")
ODD = "=P2ü"
"""A participant's code as nobody should give it."""
DEVICES = {"stimulator": {"device": "p24"}, "load_cell": {"device": "can_load_cell"}}


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One even recording with a held-out segment; one with uneven times, a gap, an angle and an empty segment."""
    folder = tmp_path_factory.mktemp("exchange-data")
    even = write(folder / "even.h5", Session("P-1", "2026-01-05", seed=1))
    with h5py.File(even, "r+") as file:
        file["segments/name"][-1] = "validate"
        file.attrs["configuration"] = json.dumps({"rig": DEVICES})  # as the rig writes it
    odd = write(folder / "odd.h5", Session(ODD, "2026-01-12", seed=2))
    random = np.random.default_rng(3)
    with h5py.File(odd, "r+") as file:
        file.attrs["configuration"] = json.dumps({"rig": DEVICES})
        size = file["torque/time_s"].shape[0]
        kept = np.r_[0:700, 703:size]
        for name in list(file["torque"]):
            values = file[f"torque/{name}"][:][kept]
            values = values + random.uniform(-2e-4, 2e-4, kept.size) if name == "time_s" else values
            del file[f"torque/{name}"]
            file[f"torque/{name}"] = values
        written = file["pulses/written_time_s"]
        written[100:103] = written[100:103] + 0.004  # late ones
        written[200], file["pulses/sent_pulse_width_us"][200], file["pulses/status"][200] = np.nan, np.nan, 2
        names, starts, ends = (file[f"segments/{name}"][:] for name in ("name", "start_s", "end_s"))
        del file["segments"]
        file["segments/name"] = [names[0].decode(), "empty", *(name.decode() for name in names[1:])]
        file["segments/start_s"] = np.r_[starts[0], starts[1], starts[1:]]
        file["segments/end_s"] = np.r_[ends[0], starts[1], ends[1:]]
        at_s = np.arange(0.005, 22.0, 0.02)
        for name, values in (("time_s", at_s), ("angle_rad", np.sin(at_s)), ("velocity_rad_s", np.cos(at_s))):
            file[f"angle/{name}"] = values
    return folder


@pytest.fixture(scope="session")
def out(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an export in each format."""
    folder = tmp_path_factory.mktemp("exchange-out")
    for name in FORMATS:
        code = main.run(["export", str(data), "--format", name, "-o", str(folder / name)])
        assert code == (1 if name == "mat" else 0), f"{name}: iddata takes no uneven times, everything else does"
    return folder

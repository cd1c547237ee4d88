"""What is handed on passes the checks of those for whom it is: NWB, FHIR, REDCap, MATLAB; and no day is in it."""

from __future__ import annotations

import csv
import gzip
import json
import re
import shutil
import subprocess
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from stimrig import identify
from stimrig.api.cli import main
from stimrig.api.exchange import outward
from stimrig.api.exchange.outward import redcap
from tests.api.exchange import redcap_rules
from tests.api.exchange.conftest import FORMATS, ODD

pytestmark = pytest.mark.slow


def test_every_format_is_found_by_its_file() -> None:
    assert set(FORMATS) == set(outward.NAMES)
    assert all(name == outward.writer(name).NAME for name in FORMATS)
    with pytest.raises(LookupError, match="edf"):
        outward.writer("edf")


# ---- NWB


def test_nwbs_inspector_finds_no_error(out: Path, tmp_path: Path, data: Path) -> None:
    from nwbinspector import Importance, inspect_nwbfile
    from pynwb import validate

    main.run(["export", str(data / "even.h5"), "--format", "nwb", "-o", str(tmp_path / "hidden"), "--no-dates"])
    files = [*(out / "nwb" / "sub-P2").rglob("*.nwb"), *(tmp_path / "hidden").rglob("*.nwb")]
    assert len(files) == 2
    for path in files:
        found = list(inspect_nwbfile(nwbfile_path=path))
        assert [one for one in found if one.importance.value >= Importance.CRITICAL.value] == []
        assert not {"ERROR", "PYNWB_VALIDATION"} & {one.importance.name for one in found}
        assert validate(path=str(path)) == []


def test_nwb_reads_back_by_pynwb(out: Path, data: Path) -> None:
    from pynwb import NWBHDF5IO

    (path,) = (out / "nwb" / "sub-P2").glob("*.nwb")
    with NWBHDF5IO(path, "r") as stored, h5py.File(data / "odd.h5") as sealed:
        file = stored.read()
        torque = file.acquisition["torque"]
        assert (torque.unit, torque.conversion) == ("N*m", 1.0)
        assert np.array_equal(torque.data[:], sealed["torque/torque_nm"][:])
        assert np.array_equal(torque.timestamps[:], sealed["torque/time_s"][:])
        pulses = file.stimulus["pulse_width"]
        sent = np.isfinite(sealed["pulses/written_time_s"][:]) & (sealed["pulses/sent_pulse_width_us"][:] > 0)
        assert np.array_equal(pulses.timestamps[:], sealed["pulses/written_time_s"][:][sent])
        assert np.array_equal(pulses.data[:], sealed["pulses/sent_pulse_width_us"][:][sent])
        assert (pulses.unit, pulses.conversion) == ("seconds", 1e-6)
        angle = file.acquisition["joint_angle"]
        assert angle.unit == "radians" and np.array_equal(angle.timestamps[:], sealed["angle/time_s"][:])
        segments = file.intervals["segments"].to_dataframe()
        assert list(segments.segment) == [name.decode() for name in sealed["segments/name"][:]]
        assert list(segments.start_time) == list(sealed["segments/start_s"][:])
        assert file.subject.subject_id == ODD and file.session_start_time.isoformat() == "2026-01-12T09:00:00+00:00"
        assert {"stimulator", "load cell", "software"} == set(file.devices)
        assert json.loads(file.notes)["stimrig"]["pulse_rate_hz"] == 40.0
        assert file.stimulus["pulses"].to_dataframe().status[200] == "dropped"
    (path,) = (out / "nwb" / "sub-P1").glob("*.nwb")
    with NWBHDF5IO(path, "r") as stored:
        segments = stored.read().intervals["segments"].to_dataframe()
        assert list(segments.held_out) == [name == "validate" for name in segments.segment]


# ---- FHIR


@pytest.mark.parametrize("release", ["r4", "r5"])
def test_fhirs_models_take_each_bundle(release: str, out: Path, data: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import fhir.resources.bundle as r5
        import fhir.resources.R4B.bundle as r4b

    model = {"r4": r4b, "r5": r5}[release].Bundle
    files = sorted((out / "fhir" / release).rglob("*.json"))
    assert len(files) == 2
    for path in files:
        model.model_validate_json(path.read_text())
        entries = json.loads(path.read_text())["entry"]
        kinds = [one["resource"]["resourceType"] for one in entries]
        assert kinds == ["Patient", "Device", "Device", "Device", "Observation", "DiagnosticReport"]
        person = entries[0]["resource"]
        assert person.keys() == {"resourceType", "identifier"}, "a participant is a code"
        assert [one["resource"]["note"][0]["text"] for one in entries[1:3]] == ["device: p24", "device: can_load_cell"]
        urls = {one["fullUrl"] for one in entries}
        referred = set(re.findall(r'"reference": "([^"]*)"', path.read_text()))
        assert referred and referred <= urls
        units = set(re.findall(r'"system": "http://unitsofmeasure.org", "code": "([^"]*)"', path.read_text()))
        assert units <= {"N.m", "us", "s", "Hz", "%", "1"}
    wrong = {"r4": r5, "r5": r4b}[release].Bundle
    with pytest.raises(ValueError, match=r"entry\.1\.resource\.type"):  # a Device of the other release
        wrong.model_validate_json(files[0].read_text())


# ---- REDCap


def test_redcap_takes_dictionary_and_table(out: Path, data: Path, tmp_path: Path) -> None:
    folder = out / "redcap"
    assert redcap_rules.broken_in_dictionary(folder / "data_dictionary.csv") == []
    assert redcap_rules.broken_in_import(folder / "import.csv", folder / "data_dictionary.csv") == []
    _, rows = redcap_rules.rows_of(folder / "import.csv")
    by_record = {row["recording_id"]: row for row in rows}
    even = by_record["R-P-1-1"]
    fitted = identify.fit(identify.read(data / "even.h5")).to_dict()
    assert float(even["fit_percent"]) == pytest.approx(fitted["fit"]["fit_percent"], rel=1e-6)
    assert float(even["threshold_us"]) == pytest.approx(fitted["uncertainty"]["figures"]["threshold_us"]["value"])
    assert even["verdict"] == fitted["quality"]["verdict"].replace(" ", "_")
    assert even["begun"] == "2026-01-05 09:00:00" and even["held_out_fit_percent"]
    assert {row["record_id"] for row in rows} == {"P-1", f"'{ODD}"}, "no spreadsheet computes a code"


def test_redcaps_rules_are_noticed(out: Path, tmp_path: Path) -> None:
    text = (out / "redcap" / "data_dictionary.csv").read_text()
    wrong = tmp_path / "wrong.csv"
    for old, new in (
        ("begun,", "Begun,"),
        ("dropdown", "radios"),
        ("datetime_seconds_ymd", "datetime"),
        ("stopped, stopped", "completed, stopped"),
        ("Field Note", "Note"),
        ("record_id", "sha256"),
    ):
        wrong.write_text(text.replace(old, new, 1))
        assert redcap_rules.broken_in_dictionary(wrong), new
    table = (out / "redcap" / "import.csv").read_text()
    for old, new in (
        ("2026-01-05 09:00:00", "05.01.2026"),
        ("completed", "done"),
        (",1,R-", ",one,R-"),
        ("kind", "sort"),
    ):
        wrong.write_text(table.replace(old, new, 1))
        assert redcap_rules.broken_in_import(wrong, out / "redcap" / "data_dictionary.csv"), new


def test_a_tests_number_stays_when_earlier_ones_come_later(data: Path, tmp_path: Path) -> None:
    from tests.harness.cohort_records import Session, write

    (tmp_path / "in").mkdir()
    shutil.copy(data / "even.h5", tmp_path / "in" / "even.h5")
    command = ["export", str(tmp_path / "in"), "--format", "redcap", "-o", str(tmp_path / "out")]
    assert main.run(command) == 0
    write(tmp_path / "in" / "before.h5", Session("P-1", "2025-12-01", seed=9))
    assert main.run(command) == 0
    _, rows = redcap_rules.rows_of(tmp_path / "out" / "import.csv")
    numbers = {row["recording_id"]: row["redcap_repeat_instance"] for row in rows}
    assert numbers == {"R-P-1-1": "1", "R-P-1-9": "2"}


def test_a_record_without_a_model_says_why(tmp_path: Path) -> None:
    rows = "".join(f"{k / 100},{100.0 if k % 50 < 25 else 0.0},0.0\n" for k in range(400))
    (tmp_path / "flat.csv").write_text("time_s,pulse_width_us,torque_nm\n" + rows)
    assert main.run(["export", str(tmp_path / "flat.csv"), "--format", "redcap", "-o", str(tmp_path / "out")]) == 0
    _, (row,) = redcap_rules.rows_of(tmp_path / "out" / "import.csv")
    assert (row["verdict"], row["fit_percent"]) == ("no_model", "") and row["no_model_reason"]
    assert set(row) > {field.name for field in redcap.FIELDS}


# ---- MATLAB


def test_a_mat_file_is_ready_for_iddata(out: Path, data: Path) -> None:
    (path,) = (out / "mat").glob("*.mat")
    found = loadmat(path, simplify_cells=True)
    record = identify.read(data / "even.h5")
    assert np.array_equal(found["y"], record.torque_nm) and np.array_equal(found["u"], record.pulse_width_us)
    assert found["Ts"] == pytest.approx(0.01) and found["Tstart"] == 0
    assert (found["OutputUnit"], found["InputUnit"], found["TimeUnit"]) == ("N*m", "us", "seconds")
    assert np.array_equal(found["held_out"].astype(bool), record.held_out)
    assert [one["name"] for one in found["segments"]] == list(record.segment_names)
    again = identify.read(path)  # and stimrig itself reads it
    assert np.array_equal(again.torque_nm, record.torque_nm) and again.segment_names == record.segment_names
    assert np.array_equal(again.pulse_width_us, record.pulse_width_us)
    assert again.time_s == pytest.approx(record.time_s, abs=1e-6)
    rows = list(csv.DictReader((out / "mat" / "errors.csv").open()))
    assert len(rows) == 1 and "even grid" in rows[0]["reason"]


def test_the_script_reads_it_in_octave(out: Path) -> None:
    octave = shutil.which("octave-cli")
    if octave is None:
        pytest.skip("octave is not installed")
    (path,) = (out / "mat").glob("*.mat")
    shown = "d.y(7), d.Ts, sum(d.held_out), d.segments{1}.name"
    line = f"d = read_stimrig('{path.name}'); printf('%.17g %.17g %d %s', {shown})"
    done = subprocess.run(
        [octave, "--no-gui", "--norc", "--eval", line], cwd=path.parent, capture_output=True, text=True
    )
    found = loadmat(path, simplify_cells=True)
    y, step_s, held_out, name = done.stdout.split()
    assert (float(y), float(step_s)) == (found["y"][6], found["Ts"]), done.stderr
    assert (int(held_out), name) == (found["held_out"].sum(), "prbs")


# ---- days, in every format


def texts(path: Path) -> str:
    """All that a person could read in a file, its name included."""
    content = path.read_bytes()
    if path.suffix == ".gz":
        content = gzip.decompress(content)
    text = content.decode("latin-1") + path.name
    if path.suffix == ".mat":
        text += repr(loadmat(path))
    if path.suffix == ".parquet":
        import pyarrow.parquet as pq

        text += repr(pq.read_table(path).to_pylist())
    if path.suffix == ".nwb":
        with h5py.File(path) as file:
            found: list[str] = []
            file.visititems(lambda name, one: found.append(f"{name} {dict(one.attrs)}"))
            file.visititems(lambda _, one: isinstance(one, h5py.Dataset) and found.append(repr(one[()])))
        text += " ".join(found)
    return text


@pytest.mark.parametrize("options", [["--no-dates"], ["--shift-days", "-9000"]], ids=lambda options: options[0])
@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("parquet", "bids")])
def test_days_that_are_hidden_stand_nowhere(name: str, options: list[str], data: Path, tmp_path: Path) -> None:
    """Of Parquet and BIDS `tests/api/cohort/test_export_verb.py` shows it."""
    command = ["export", str(data / "even.h5"), "--format", name, "-o", str(tmp_path / "out"), *options]
    assert main.run(command) == 0
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file() and ".stimrig-export" not in path.parts]
    assert files
    for path in files:
        found = texts(path)
        for day in ("2026-01-05", "20260105", "T-1", "even.h5"):
            assert day not in found, (path, day)
    if name != "mat":
        told = any("2001-05-1" in texts(path) for path in files)
        assert told == (options[0] == "--shift-days"), "the moved day is told, and only that"

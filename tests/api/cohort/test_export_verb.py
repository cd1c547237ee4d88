"""`stimrig export`: what is handed on reads back as what was recorded; one that is cut off goes on."""

from __future__ import annotations

import csv
import gzip
import json
import math
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from stimrig import identify
from stimrig.api.cli import main
from stimrig.api.cli.commands import export as export_verb
from stimrig.api.cohort.export import ERRORS, Days, Export, Writer
from stimrig.api.cohort.export_state import FOLDER, State
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import sources_of
from stimrig.api.cohort.tally import Tell
from stimrig.api.cohort.tasks import CohortError, CutOffError
from stimrig.api.exchange.outward import parquet as parquet_files
from stimrig.api.exchange.outward.parquet import STATUS
from stimrig.rig import archive, assembly, journal
from tests.api.test_schemas import unmet
from tests.harness.cohort_records import Session, broken, write
from tests.rig.fakes import VirtualRig

CSV = "time_s,pulse_width_us,torque_nm,segment\n" + "".join(
    f"{k / 100!r},{100.0 if k % 200 < 100 else 0.0},{math.sin(k / 30)!r},{'prbs' if k < 600 else 'validate'}\n"
    for k in [*range(300), *range(310, 900)]  # ten samples are lost
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people, a stopped test of the rig with dropped pulses, a table with a gap, and ten files that are none."""
    folder = tmp_path_factory.mktemp("data")
    for number, (who, day) in enumerate([("P-1", "2026-01-05"), ("P-1", "2026-01-12"), ("P2", "2026-01-05")]):
        write(folder / f"session-{number}.h5", Session(who, day, seed=number))
    played = tmp_path_factory.mktemp("played")
    rig = VirtualRig(played)
    rig.cell.noise_nm = 0.01
    rig.at(0.8, lambda: setattr(rig.stimulator, "ack_delay_s", 0.03))
    rig.at(1.4, lambda: rig.halt.set("stopped", "enough"))
    rig.execute()
    recording = assembly.assemble(journal.read(rig.path))
    assert 2 in recording.columns["pulses/status"], "some pulses were dropped"
    archive.seal(recording, folder, rig.machine.disk)
    (folder / "table.csv").write_text(CSV)
    broken(folder, folder / "session-0.h5")
    return folder


def exported(data: Path, folder: Path, kind: str, *options: str) -> None:
    """Export what is there; exit code 1 if, and only if, something of it could not be."""
    code = main.run(["export", str(data), f"--{kind}", str(folder), "--json", *options])
    with (folder / ERRORS).open() as file:
        assert code == bool(list(csv.DictReader(file)))


def sealed_files(data: Path) -> dict[str, Path]:
    found = {}
    for path in sorted(data.glob("*.h5")):
        try:
            found[identify.read(path).source.recording_id] = path
        except identify.BadRecord:
            continue
    return found


def test_parquet_reads_back_to_the_same_numbers(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exported(data, tmp_path / "out", "parquet")
    told = json.loads(capsys.readouterr().out)
    assert (told["records"], told["errors"]) == (5, 10)
    assert unmet("export", told) == []
    samples = ds.dataset(tmp_path / "out" / "samples", partitioning="hive")
    pulses = ds.dataset(tmp_path / "out" / "pulses", partitioning="hive")
    records = pq.read_table(tmp_path / "out" / "records.parquet").to_pylist()
    assert len(records) == 5 and len(sealed_files(data)) == 4
    for record_id, path in sealed_files(data).items():
        found = samples.to_table(filter=ds.field("record_id") == record_id).to_pydict()
        heard = pulses.to_table(filter=ds.field("record_id") == record_id).to_pydict()
        with h5py.File(path) as file:
            for name in ("time_s", "torque_nm"):
                assert np.array_equal(found[name], file[f"torque/{name}"][:])
            for name in ("planned_time_s", "sent_pulse_width_us", "written_time_s", "acknowledged_time_s"):
                column = np.array(heard[name], float)  # null becomes NaN
                assert np.array_equal(column, file[f"pulses/{name}"][:], equal_nan=True)
            assert heard["status"] == [STATUS[code] for code in file["pulses/status"][:]]
            assert set(found["participant"]) == {file.attrs["participant"]}
        record = identify.read(path)
        inside = np.array([name is not None for name in found["segment"]])
        assert np.array_equal(np.array(found["time_s"])[inside], record.time_s)
        assert np.array_equal(np.array(found["pulse_width_us"], float)[inside], record.pulse_width_us)
        names = np.array(found["segment"], object)[inside]
        again = identify.Record.from_arrays(
            np.array(found["time_s"])[inside], np.array(found["pulse_width_us"], float)[inside],
            np.array(found["torque_nm"])[inside], list(names), pulse_rate_hz=record.pulse_rate_hz,
        )  # fmt: skip
        assert again.segment_names == record.segment_names
        assert np.array_equal(again.held_out, record.held_out)
        assert np.array_equal(np.array(found["held_out"])[inside], record.held_out)
    table = identify.read(data / "table.csv")
    row = next(row for row in records if row["format"] == "table")
    found = samples.to_table(filter=ds.field("record_id") == row["record_id"]).to_pydict()
    assert np.array_equal(found["torque_nm"], table.torque_nm) and np.array_equal(found["time_s"], table.time_s)
    assert row["participant"] == "unknown" and row["pulses"] == 0


def test_each_column_says_its_unit_and_stands_in_the_dictionary(data: Path, tmp_path: Path) -> None:
    exported(data, tmp_path / "out", "parquet", "--select", 'participant == "P2"')
    tables = json.loads((tmp_path / "out" / "data_dictionary.json").read_text())["tables"]
    with (tmp_path / "out" / "data_dictionary.csv").open() as file:
        listed = {(row["table"], row["name"]): row for row in csv.DictReader(file)}
    for name in ("samples", "pulses", "records"):
        place = tmp_path / "out" / (f"{name}.parquet" if name == "records" else name)
        schema = pq.read_schema(place if place.is_file() else next(place.rglob("*.parquet")))
        assert set(schema.names) == set(tables[name])
        for field in schema:
            assert field.metadata[b"unit"].decode() == tables[name][field.name]["unit"]
            assert tables[name][field.name]["meaning"] and listed[name, field.name]["meaning"]
            assert (tables[name][field.name]["unit"] == "s") <= field.name.endswith("_s")
    assert len(pq.read_table(tmp_path / "out" / "records.parquet")) == 1


def bids_columns(place: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A continuous recording with its sidecar."""
    head = json.loads(place.with_name(place.name.removesuffix(".tsv.gz") + ".json").read_text())
    with gzip.open(place, "rt") as file:
        rows = [
            [np.nan if cell == "n/a" else float(cell) for cell in line.split("\t")] for line in file.read().splitlines()
        ]
    return head, dict(zip(head["Columns"], np.array(rows).T, strict=True))


def test_bids_reads_back_to_the_same_numbers(data: Path, tmp_path: Path) -> None:
    exported(data, tmp_path / "out", "bids")
    seen = 0
    for place in sorted((tmp_path / "out").rglob("*_physio.tsv.gz")):
        head, physio = bids_columns(place)
        _, stim = bids_columns(place.with_name(place.name.replace("_physio", "_stim")))
        there = ~np.isnan(physio["torque_nm"])
        time_s = head["StartTime"] + np.arange(len(there)) / head["SamplingFrequency"]
        if head["RecordingID"] not in sealed_files(data):
            record = identify.read(data / "table.csv")
            assert np.sum(~there) == 10, "the lost samples are rows without values"
            torque_nm, wanted_s = record.torque_nm, record.time_s
        else:
            path = sealed_files(data)[head["RecordingID"]]
            with h5py.File(path) as file:
                torque_nm, wanted_s = file["torque/torque_nm"][:], file["torque/time_s"][:]
                check_events(place.with_name(place.name.replace("_physio.tsv.gz", "_events.tsv")), file)
            record = identify.read(path)
        assert np.array_equal(physio["torque_nm"][there], torque_nm)
        assert time_s[there] == pytest.approx(wanted_s, abs=1e-6)
        known = ~np.isnan(stim["pulse_width_us"])
        assert np.array_equal(stim["pulse_width_us"][known], record.pulse_width_us)
        assert all({"Description"} <= set(head[name]) for name in head["Columns"])
        seen += 1
    assert seen == 5
    listed = (tmp_path / "out" / "participants.tsv").read_text().splitlines()
    assert listed[0] == "participant_id\tcode\tsessions\trecordings"
    assert "sub-P1\tP-1\t2\t2" in listed and "sub-P2\tP2\t1\t1" in listed
    scans = tmp_path / "out" / "sub-P1" / "ses-20260112" / "sub-P1_ses-20260112_scans.tsv"
    name, when = scans.read_text().splitlines()[1].split("\t")[:2]
    assert (scans.parent / name).exists() and when == "2026-01-12T09:00:00Z"


def check_events(place: Path, file: Any) -> None:
    with place.open() as lines:
        rows = list(csv.DictReader(lines, delimiter="\t"))
    written = np.where(file["pulses/status"][:] == 1, np.nan, file["pulses/written_time_s"][:])
    pulses = [row for row in rows if row["trial_type"] == "pulse"]
    assert [float(row["onset"]) for row in pulses] == list(written[np.isfinite(written)])
    widths = file["pulses/sent_pulse_width_us"][:][np.isfinite(written)]
    assert [float(row["pulse_width"]) for row in pulses] == list(widths)
    segments = [row for row in rows if row["trial_type"] == "segment"]
    assert [row["segment"] for row in segments] == [name.decode() for name in file["segments/name"][:]]
    assert [float(row["onset"]) for row in segments] == list(file["segments/start_s"][:])
    onsets = [float(row["onset"]) for row in rows]
    assert onsets == sorted(onsets)
    dropped = [row for row in rows if row["trial_type"] == "pulse_not_sent"]
    assert len(dropped) == np.sum(np.isin(file["pulses/status"][:], (2, 3)))


def test_the_validator_finds_no_error(data: Path, tmp_path: Path) -> None:
    validator = shutil.which("bids-validator-deno")
    if validator is None:
        pytest.skip("bids-validator-deno is not installed")
    exported(data, tmp_path / "out", "bids", "--no-dates")
    exported(data, tmp_path / "dated", "bids")
    for folder in ("out", "dated"):
        command = [validator, str(tmp_path / folder), "--max-rows", "-1", "--format", "json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        issues = json.loads(done.stdout)["issues"]["issues"]
        assert [issue for issue in issues if issue["severity"] == "error"] == []
        assert not {issue["code"] for issue in issues} & {"NOT_INCLUDED", "TSV_ADDITIONAL_COLUMNS_UNDEFINED"}


def test_what_is_no_record_is_a_line_with_its_reason(data: Path, tmp_path: Path) -> None:
    exported(data, tmp_path / "out", "parquet")
    with (tmp_path / "out" / "errors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    assert {Path(row["address"]).name for row in rows} >= {"half.h5", "words.csv", "nul.mat"}
    assert all(row["kind"] == "bad record" and row["reason"] and "Traceback" not in row["reason"] for row in rows)
    assert all("record." not in row["reason"].split(":")[0] for row in rows), "messages name the file as it is called"


class CutOff:
    """A disk that is full after some records."""

    NAME = parquet_files.NAME
    finish = staticmethod(parquet_files.finish)

    def __init__(self, after: int) -> None:
        self.left = after

    def write(self, record: Any, who: Any, put: Any) -> dict[str, Any]:
        if self.left == 0:
            with put("samples/half.parquet") as file:
                file.write(b"half of it")
                raise OSError(28, "No space left on device")
        self.left -= 1
        return parquet_files.write(record, who, put)


def content(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file() and FOLDER not in path.parts]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_one_that_is_cut_off_goes_on_and_ends_as_if_it_had_not_been(data: Path, tmp_path: Path) -> None:
    def run(folder: Path, writer: Writer) -> Export:
        state = State(folder, {})
        export = Export(sources_of([str(data)]), Selection(), state, writer, Days())
        try:
            export.go()
        finally:
            state.close()
        return export

    with pytest.raises(CutOffError, match="No space left"):
        run(tmp_path / "cut", CutOff(2))
    (tmp_path / "cut" / FOLDER / "1234.part").write_bytes(b"left by a kill")
    assert not (tmp_path / "cut" / "samples" / "half.parquet").exists()
    again = run(tmp_path / "cut", parquet_files)
    assert (again.tally.before, again.tally.ok) == (2, 3)
    run(tmp_path / "whole", parquet_files)
    assert content(tmp_path / "cut") == content(tmp_path / "whole")
    assert list((tmp_path / "cut" / FOLDER).glob("*.part")) == []
    third = run(tmp_path / "cut", parquet_files)
    assert (third.tally.before, third.tally.ok) == (5, 0)


def test_a_record_that_changed_takes_the_place_of_what_it_was(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    table = tmp_path / "data" / "t.csv"
    table.write_text(CSV)
    exported(table, tmp_path / "out", "bids")
    before = {name for name in content(tmp_path / "out") if "_physio.tsv" in name}
    table.write_text(CSV.replace("validate", "ramp"))
    exported(table, tmp_path / "out", "bids")
    after = {name for name in content(tmp_path / "out") if "_physio.tsv" in name}
    assert len(before) == len(after) == 1 and before != after


def test_days_that_are_hidden_stand_nowhere(data: Path, tmp_path: Path) -> None:
    good = [path for path in data.iterdir() if path.name.startswith("session")]
    for kind in ("parquet", "bids"):
        for options in (("--no-dates",), ("--shift-days", "-9000")):
            folder = tmp_path / f"{kind}{len(options)}"
            assert main.run(["export", *map(str, good), f"--{kind}", str(folder), *options]) == 0
            for name, data_ in content(folder).items():
                text = (gzip.decompress(data_) if name.endswith(".gz") else data_) + name.encode()
                if name.endswith(".parquet"):
                    text += json.dumps(pq.read_table(folder / name).to_pylist(), default=str).encode()
                for day in (b"2026-01-05", b"20260105", b"2026-01-12", b"20260112", b"session-0.h5"):
                    assert day not in text, (name, day)
    moved = content(tmp_path / "bids2")
    assert any("ses-20010" in name for name in moved)
    sessions = {name.split("/")[1] for name in content(tmp_path / "bids1") if name.startswith("sub-P1/")}
    assert len(sessions) == 2, "sessions of one person stay apart"


def test_two_codes_with_one_label_are_not_mixed(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for number, who in enumerate(("P-1", "P_1", "--")):
        write(data / f"{number}.h5", Session(who, "2026-01-05", seed=number))
    exported(data, tmp_path / "out", "bids")
    rows = list(csv.DictReader((tmp_path / "out" / "errors.csv").open()))
    assert len(rows) == 2 and all(row["kind"] == "label" for row in rows)
    listed = (tmp_path / "out" / "participants.tsv").read_text()
    assert ("P-1" in listed) != ("P_1" in listed)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ([], "--parquet"),
        (["--parquet", "a", "--bids", "b"], "--parquet"),
        (["--bids", "b", "--no-dates", "--shift-days", "3"], "--shift-days"),
        (["--bids", "b", "--select", "nonsense == 1"], "nonsense"),
    ],
)
def test_wrong_options_are_one_line(
    options: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    assert main.run(["export", "data", *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and named in said


def test_a_folder_of_something_else_is_left_alone(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"x")
    with pytest.raises(CohortError, match="not empty"):
        State(tmp_path / "photos", {})
    exported(data, tmp_path / "out", "bids", "--select", 'participant == "P2"')
    assert main.run(["export", str(data), "--bids", str(tmp_path / "out"), "--no-dates"]) == 2
    assert "other options" in capsys.readouterr().err
    assert main.run(["export", str(tmp_path / "nowhere"), "--bids", str(tmp_path / "new")]) == 2
    assert not (tmp_path / "new").exists()


def test_one_of_several_that_fails_is_told_and_the_others_are_done(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shell script goes on after an exit code 0: it believed that all was exported."""
    shown: list[tuple[int, int | None]] = []

    @contextmanager
    def telling() -> Iterator[Tell]:
        yield lambda tally: shown.append((tally.handled, tally.total))

    monkeypatch.setattr(export_verb, "telling", telling)
    monkeypatch.setattr(threading.Thread, "start", threading.Thread.run)  # counted before the first is written
    bad = tmp_path / "bad.h5"
    bad.write_bytes(b"no recording")
    given = [str(data / "session-0.h5"), str(bad), str(data / "session-2.h5")]
    assert main.run(["export", *given, "--bids", str(tmp_path / "out"), "--json"]) == 1
    out, err = capsys.readouterr()
    assert (json.loads(out)["records"], json.loads(out)["errors"]) == (2, 1)
    assert err.count("\n") == 1 and "1 of 3 records gave no result" in err and str(tmp_path / "out" / ERRORS) in err
    assert shown == [(1, 3), (2, 3), (3, 3)], "the bar knows of how many"
    bad.unlink()
    del given[1]
    assert main.run(["export", *given, "--bids", str(tmp_path / "out")]) == 0, "what is no longer asked for"


def test_records_are_read_from_a_bucket_too(data: Path, tmp_path: Path) -> None:
    import fsspec

    files = fsspec.filesystem("memory")
    files.pipe("/export/session.h5", (data / "session-0.h5").read_bytes())
    assert main.run(["export", "memory://export", "--bids", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "sub-P1" / "ses-20260105").is_dir()

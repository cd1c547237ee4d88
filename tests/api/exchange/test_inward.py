"""What is taken in is what the file holds, to the last bit; what the file does not say is asked for, never guessed."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import stimrig
from stimrig import identify
from stimrig.api.cli import main
from stimrig.api.cohort.export import Who
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.exchange.outward import _figures, bids, fhir, nwb
from stimrig.errors import BadRequest
from stimrig.identify.records.columns import parsed
from tests.api.test_schemas import unmet
from tests.harness import foreign_files
from tests.harness.foreign_files import Stream

pytestmark = pytest.mark.slow
PLACES = {"nwb": "sub-*/*.nwb", "parquet": "samples/*/*/*.parquet", "bids": "*/*/beh/*_physio.tsv.gz",
          "fhir": "r*/*/*/*.json"}  # fmt: skip
CARRIED = {"nwb": {"late_s", "doubted", "angle_rad", "velocity_rad_s"}, "parquet": {"late_s", "doubted"},
           "bids": {"late_s", "doubted"}, "fhir": set()}  # fmt: skip
"""Further columns of a sealed recording that come back."""


def files_of(out: Path, name: str) -> list[Path]:
    return sorted((out / name).glob(PLACES[name]))


@pytest.mark.parametrize("name", PLACES)
def test_a_recording_comes_back_to_the_last_bit(name: str, out: Path, data: Path, tmp_path: Path, capsys: Any) -> None:
    sealed = {one.source.recording_id: one for one in map(identify.read, sorted(data.glob("*.h5")))}
    seen = set()
    for path in files_of(out, name):
        place = tmp_path / "taken.csv"
        assert main.run(["import", str(path), "-o", str(place), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert unmet("import", told) == [] and told["answered_by"] == "our own export"
        again = identify.read(place)
        record = sealed[told["about"]["recording_id"]]
        seen.add(record.source.recording_id)
        assert np.array_equal(again.torque_nm, record.torque_nm)
        assert np.array_equal(again.pulse_width_us, record.pulse_width_us)
        assert again.time_s == pytest.approx(record.time_s, rel=0, abs=1e-6)
        assert again.segment_names == record.segment_names and np.array_equal(again.segment, record.segment)
        assert np.array_equal(again.held_out, record.held_out)
        assert again.pulse_rate_hz == record.pulse_rate_hz and len(again.parts) == 1
        for column, values in record.columns().items():
            if column in CARRIED[name]:
                assert np.allclose(again.columns()[column], values, rtol=0, atol=1e-12), column
        comment = place.read_text().splitlines()[0]
        assert json.loads(comment.partition(": ")[2])["taken"] == told["taken"], "kept in the output"
    assert seen == set(sealed)


def in_memory(record: WholeRecord, who: Who, module: Any, folder: Path) -> list[Path]:
    """A record through a format's writer, without an export around it."""
    written = []

    class Put(io.BytesIO):
        def __init__(self, place: str) -> None:
            super().__init__()
            self.place = folder / place

        def __exit__(self, *_: object) -> None:
            self.place.parent.mkdir(parents=True, exist_ok=True)
            self.place.write_bytes(self.getvalue())
            written.append(self.place)

    module.write(record, who, Put)
    return written


FINITE = st.floats(-1e6, 1e6, allow_nan=False)


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    torque=st.lists(FINITE, min_size=12, max_size=40),
    widths=st.lists(st.floats(1.5, 1e4), min_size=12, max_size=40),
    jitter=st.floats(0, 2e-3),
    name=st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=20),
)
def test_any_numbers_come_back(
    torque: list[float], widths: list[float], jitter: float, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    size = min(len(torque), len(widths))
    time_s = np.arange(size) / 100 + jitter * np.sin(np.arange(size))
    columns = {"time_s": time_s, "torque_nm": np.array(torque[:size]), "pulse_width_us": np.array(widths[:size])}
    columns["segment"] = np.zeros(size)
    about = {"pulse_rate_hz": 40.0, "segment_names": [name], "record_id": "R", "participant": name}
    record = WholeRecord("0" * 64, about, columns, segments=[(name, float(time_s[0]), float(time_s[-1]) + 0.005)])
    folder = tmp_path_factory.mktemp("any")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_figures, "fitted", lambda _: {"verdict": "usable"})
        for module in (nwb, fhir, bids):
            written = in_memory(record, Who(name, "P", "undated", "R", "0123456789abcdef", None), module, folder)
            for path in (one for one in written if one.suffix in (".nwb", ".json", ".gz") and one.parent.name != "r5"):
                if path.name.endswith(("_stim.tsv.gz", "_stim.json", "_physio.json", "_events.json")):
                    continue
                again = stimrig.import_recording(path)
                assert np.array_equal(again.torque_nm, columns["torque_nm"]), path
                assert np.array_equal(again.pulse_width_us, columns["pulse_width_us"]), path
                assert again.time_s == pytest.approx(time_s, rel=0, abs=1e-6)
                if module is not bids:  # which has no line breaks, and an apostrophe before formulas
                    assert again.segment_names == (name,)


# ---- what a foreign file does not say


RATE_HZ = 200.0
TIME_S = np.arange(int(20 * RATE_HZ)) / RATE_HZ
PULSES_S = np.arange(800) / 40.0
WIDTHS_US = np.where(PULSES_S % 4 < 2, 250.0, 0.0) + 50.0 * (PULSES_S % 1 < 0.5)
FORCE_N = np.round(-40 * np.sin(TIME_S), 2)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sent = WIDTHS_US > 0
    return foreign_files.nwb(
        tmp_path_factory.mktemp("foreign") / "bench.nwb", TIME_S, FORCE_N, PULSES_S[sent], WIDTHS_US[sent]
    )


def test_what_is_not_known_is_asked_for_one_by_one(foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    given = ["import", str(foreign), "-o", str(tmp_path / "out.csv")]
    for named, choice, answer in (
        ("--map torque_nm=", "Dynamometer/1 (N", ["--map", "torque_nm=Dynamometer/1"]),
        ("--lever-arm-m", "force", ["--lever-arm-m", "0.25"]),
        ("--sign", "+1, -1", ["--sign", "-1"]),
        ("--segments", "epochs, none", ["--segments", "epochs"]),
        ("--map pulse_width_us=", "Stim (us", ["--map", "pulse_width_us=Stim"]),
    ):
        assert main.run(given) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and named in said and choice in said, said
        assert not (tmp_path / "out.csv").exists()
        given += answer
    for target in ("time_s=Zeit:s", "segment=part"):  # it would be passed over
        assert main.run([*given, "--map", target]) == 2 and "does not take it" in capsys.readouterr().err
    assert main.run([*given, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert unmet("import", told) == []
    torque = {"signal": "Dynamometer/1", "unit": "N", "samples": 4000, "lever_arm_m": 0.25, "factor": 0.25, "sign": -1}
    assert told["taken"]["torque_nm"] == torque
    assert told["taken"]["pulse_rate_hz"] == 40 and told["taken"]["segments"] == "epochs"
    record = identify.read(tmp_path / "out.csv")
    assert record.torque_nm == pytest.approx(-0.25 * FORCE_N) and list(record.segment_names) == ["prbs", "validate"]
    assert np.sum(record.held_out) == 2000
    assert record.pulse_width_us == pytest.approx(np.repeat(WIDTHS_US, 5))
    same = stimrig.import_recording(
        foreign, {"torque_nm": "Dynamometer/1", "pulse_width_us": "Stim"}, "epochs", sign=-1, lever_arm_m=0.25
    )
    assert np.array_equal(same.torque_nm, record.torque_nm)


def test_a_person_at_the_terminal_is_asked(foreign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = {"torque_nm": "Mystery", "UNIT": "Ncm", "sign": "+1", "segments": "none", "pulse_width": "Stim"}
    asked: list[str] = []

    def prompt(text: str, **_: object) -> str:
        asked.append(text)
        return answers[next(key for key in ("UNIT", *answers) if key in text)]

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("typer.prompt", prompt)
    assert main.run(["import", str(foreign), "-o", str(tmp_path / "out.csv")]) == 0
    assert len(asked) == 5
    record = identify.read(tmp_path / "out.csv")
    assert record.torque_nm == pytest.approx(FORCE_N / 100) and not record.held_out.any()


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({"map": {"torque_nm": "Torque"}}, "no signal is called 'Torque'"),
        ({"map": {"torque_nm": "Mystery:Nmol"}}, "unit 'Nmol' is not known"),
        ({"sign": 2}, "no sign"),
        ({"lever_arm_m": -1.0}, "--lever-arm-m"),
        ({"segments": "trials"}, "no segments are called"),
        ({"pulse_rate_hz": 1000.0}, "1 to 200"),
        ({"pulse_rate_hz": 10.0}, "two pulses in one interval"),
    ],
)
def test_an_answer_that_cannot_be_used_is_refused(more: dict[str, Any], named: str, foreign: Path) -> None:
    right = {"map": {"torque_nm": "Dynamometer/1"}, "segments": "epochs", "sign": 1, "lever_arm_m": 0.2}
    wanted = {**right, **more}
    wanted["map"] = {"pulse_width_us": "Stim", **wanted["map"]}
    with pytest.raises((BadRequest, identify.BadRecord), match=named):
        stimrig.import_recording(foreign, **wanted)


def test_a_foreign_bids_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torque = np.where((np.arange(4000) > 2000) & (np.arange(4000) < 2010), np.nan, np.sin(TIME_S))
    widths = np.where(np.isnan(torque), np.nan, np.repeat(WIDTHS_US, 5))
    path = foreign_files.bids(tmp_path, {"moment": torque, "stim_width": widths}, {"moment": "N.m"}, RATE_HZ)
    command = ["import", str(path), "-o", str(tmp_path / "out.csv"), "--map", "torque_nm=moment", "--sign", "+1",
               "--map", "pulse_width_us=stim_width", "--segments", "events"]  # fmt: skip
    assert main.run(command) == 2
    assert "--map pulse_width_us=stim_width:UNIT" in capsys.readouterr().err, "no unit is guessed"
    command[command.index("pulse_width_us=stim_width")] += ":us"
    assert main.run(command) == 2
    assert "--pulse-rate-hz" in capsys.readouterr().err
    assert main.run([*command, "--pulse-rate-hz", "40"]) == 0
    record = identify.read(tmp_path / "out.csv")
    assert record.time_s.size == 4000 - 9 and set(record.segment_names) == {"prbs", "validate"}


def test_a_foreign_table_of_parquet(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = {"Zeit [ms]": TIME_S * 1000, "M": np.sin(TIME_S), "pw": np.repeat(WIDTHS_US, 5)}
    pq.write_table(pa.table(table), tmp_path / "t.parquet")
    mapped = {"torque_nm": "M:Nm", "pulse_width_us": "pw:us"}
    record = stimrig.import_recording(tmp_path / "t.parquet", mapped, sign=1, pulse_rate_hz=40)
    assert np.array_equal(record.torque_nm, np.sin(TIME_S)) and record.time_s == pytest.approx(TIME_S)


# ---- LSL


def own_streams(data: Path, zero_s: float = 51234.5) -> tuple[identify.Record, bytes]:
    """A test as docs/lsl.md streams it: what was before and after it too."""
    record = identify.read(data / "even.h5")
    with h5py.File(data / "even.h5") as file:
        sent = file["pulses/sent_pulse_width_us"][:] > 0
        written_s, widths = file["pulses/written_time_s"][:][sent], file["pulses/sent_pulse_width_us"][:][sent]
    around = np.r_[-0.02, -0.01, record.time_s]
    torque = np.r_[9.0, 9.0, record.torque_nm].reshape(-1, 1)
    mark = {"event": "start", "recording_id": "R-P-1-1", "participant": "P-1", "kind": "pre-session"}
    pulses = np.column_stack([widths, np.full(widths.size, 20.0), np.arange(widths.size)])
    channels = (("pulse_width", "µs"), ("current", "mA"), ("index", "1"))
    texts = [json.dumps(mark), json.dumps({"event": "end", "outcome": "completed"})]
    return record, foreign_files.xdf([
        Stream("stimrig-torque", "Torque", 100.0, (("torque", "N·m"),), around + zero_s, torque),
        Stream("stimrig-pulses", "Stimulation", 0.0, channels, written_s + zero_s, pulses),
        Stream("stimrig-tests", "Markers", 0.0, (("mark", "JSON"),), [zero_s, zero_s + 22.8], texts),
        Stream("EEG", "EEG", 250.0, (("Fz", "uV"),), np.arange(500) / 250 + zero_s, np.zeros((500, 1))),
    ])  # fmt: skip


def test_our_own_streams_are_taken_without_a_question(data: Path, tmp_path: Path) -> None:
    record, content = own_streams(data)
    (tmp_path / "lab.xdf").write_bytes(content)
    again = stimrig.import_recording(tmp_path / "lab.xdf")
    assert np.array_equal(again.torque_nm, record.torque_nm)
    assert again.time_s == pytest.approx(record.time_s, rel=0, abs=1e-6)
    # the rig sends a pulse 1 ms after its slot, and a stream tells of rests nothing
    same = again.pulse_width_us == record.pulse_width_us
    assert np.mean(same) > 0.95 and set(again.pulse_width_us) == set(record.pulse_width_us)
    assert again.pulse_rate_hz == 40 and again.source.recording_id == "R-P-1-1"


def strange(offset_s: float, measured: bool = True) -> bytes:
    """A lab's streams on two hosts, the stimulator's clock ahead by an offset; some samples are lost."""
    kept = np.r_[0:1000, 1040:4000]
    at = [(float(t), -offset_s) for t in np.arange(0, 21, 5.0)]
    none = [(float(t), 0.0) for t in np.arange(0, 21, 5.0)]
    sent = WIDTHS_US > 0
    edges = np.r_[0.0, 10.0, 20.0] + offset_s
    return foreign_files.xdf([
        Stream("Biodex", "Torque", 200.0, (("torque", ""),), TIME_S[kept], FORCE_N[kept, None], "a",
               none if measured else ()),
        Stream("Stim", "Stimulation", 0.0, (("pw", "us"),), PULSES_S[sent] + offset_s, WIDTHS_US[sent, None], "b",
               at if measured else ()),
        Stream("Trigger", "Markers", 0.0, (("m", ""),), PULSES_S[sent] + offset_s, ["T"] * int(sent.sum()), "b",
               at if measured else ()),
        Stream("Blocks", "Markers", 0.0, (("m", ""),), edges, ["prbs", "validate", "end"], "b", at if measured else ()),
    ])  # fmt: skip


def test_streams_with_clocks_of_their_own_come_to_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.xdf").write_bytes(strange(100.0))
    command = ["import", str(tmp_path / "lab.xdf"), "-o", str(tmp_path / "out.csv"), "--map", "torque_nm=Biodex:Nm",
               "--map", "pulse_width_us=Stim", "--sign", "+1"]  # fmt: skip
    assert main.run(command) == 2 and "--segments; there are: Blocks, none" in capsys.readouterr().err
    assert main.run([*command, "--segments", "Blocks", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert any("40 samples lost" in note for note in told["notes"]), told["notes"]
    record = identify.read(tmp_path / "out.csv")
    whole = np.repeat(WIDTHS_US, 5)[np.r_[0:1000, 1040:4000]]
    assert record.pulse_width_us == pytest.approx(whole[: record.time_s.size])
    assert record.time_s.size == 3960 and set(record.segment_names) == {"prbs", "validate"}


def test_clocks_that_nobody_measured_are_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.xdf").write_bytes(strange(100.0, measured=False))
    command = ["import", str(tmp_path / "lab.xdf"), "-o", str(tmp_path / "out.csv"), "--map", "torque_nm=Biodex:Nm",
               "--map", "pulse_width_us=Trigger", "--sign", "+1", "--segments", "none"]  # fmt: skip
    assert main.run(command) == 2 and "--clock-offset-s" in capsys.readouterr().err
    assert main.run([*command, "--clock-offset-s", "-100"]) == 2 and "--pulse-width-us" in capsys.readouterr().err
    assert main.run([*command, "--clock-offset-s", "-100", "--pulse-width-us", "300"]) == 0
    assert set(identify.read(tmp_path / "out.csv").pulse_width_us) == {0.0, 300.0}
    segments = [*command[:-1], "Blocks", "--clock-offset-s", "-100"]
    assert main.run(segments) == 2 and "clocks of their own" in capsys.readouterr().err


def test_maps_of_the_verb_are_those_of_data() -> None:
    assert parsed(["torque_nm=a:b:Nm"])["torque_nm"].name == "a:b"

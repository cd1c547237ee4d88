"""Files of others as weapons, and broken ones: each is refused in one line that says where and what to do."""

from __future__ import annotations

import gzip
import json
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stimrig.api.cli import main
from stimrig.api.exchange.inward import bids as bids_in
from stimrig.api.exchange.inward import nwb as nwb_in
from stimrig.api.exchange.inward import parquet as parquet_in
from tests.harness import foreign_files
from tests.harness.foreign_files import Stream, chunk

pytestmark = pytest.mark.slow
SECRET = "the-secret-of-the-service"
N = 2000
TIME_S = np.arange(N) / 100
WIDTHS = np.where(np.arange(N) % 200 < 100, 200.0, 0.0)
ANSWERS = ["--map", "torque_nm=torque:Nm", "--map", "pulse_width_us=width:us", "--sign", "+1", "--pulse-rate-hz", "40",
           "--segments", "none"]  # fmt: skip


def hdf5(change: Callable[[h5py.File], None], torque: np.ndarray | None = None) -> Callable[[Path], Path]:
    """A plain NWB file with one change."""

    def make(folder: Path) -> Path:
        path = folder / "x.nwb"
        (folder / "secret.txt").write_bytes(SECRET.encode() * 2000)
        with h5py.File(path, "w") as file:
            file.attrs["nwb_version"] = "2.7.0"
            for name, values in (("torque", np.sin(TIME_S) if torque is None else torque), ("width", WIDTHS)):
                file[f"acquisition/{name}/data"] = values
                file[f"acquisition/{name}/data"].attrs["unit"] = "Nm" if name == "torque" else "us"
                file[f"acquisition/{name}/timestamps"] = TIME_S
            change(file)
        return path

    return make


def replaced(where: str, make: Callable[[h5py.File, str], object]) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[where]
        make(file, where)

    return change


DATA = "acquisition/torque/data"


def huge(file: h5py.File, where: str) -> None:
    file.create_dataset(where, shape=(2**40,), chunks=(1024,), dtype="f8", compression="gzip")


def virtual(file: h5py.File, where: str) -> None:
    layout = h5py.VirtualLayout((N,), "f8")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (N,))
    file.create_virtual_dataset(where, layout)


def external(file: h5py.File, where: str) -> None:
    file.create_dataset(where, (N,), "f8", external=[(str(Path(file.filename).parent / "secret.txt"), 0, 8 * N)])


def nwbs() -> Iterator[tuple[str, Callable[[Path], Path]]]:
    yield "external link", hdf5(replaced(DATA, lambda f, w: f.__setitem__(w, h5py.ExternalLink("secret.txt", "/x"))))
    yield "external storage", hdf5(replaced(DATA, external))
    yield "virtual", hdf5(replaced(DATA, virtual))
    yield "a link to itself", hdf5(replaced(DATA, lambda f, w: f.__setitem__(w, h5py.SoftLink(f"/{w}"))))
    yield "a terabyte declared", hdf5(replaced(DATA, huge))
    yield "a wide table", hdf5(replaced(DATA, lambda f, w: f.create_dataset(w, (N, 10**7), "f8", chunks=(1, 1000))))
    yield "three dimensions", hdf5(replaced(DATA, lambda f, w: f.__setitem__(w, np.zeros((4, 5, 6)))))
    yield "texts", hdf5(replaced(DATA, lambda f, w: f.__setitem__(w, ["a"] * N)))
    yield "other length", hdf5(replaced(DATA, lambda f, w: f.__setitem__(w, np.zeros(7))))
    yield "compound times", hdf5(replaced("acquisition/torque/timestamps", lambda f, w: f.__setitem__(
        w, np.zeros(N, [("a", "f8")]))))  # fmt: skip
    yield "no times", hdf5(lambda f: f.__delitem__("acquisition/torque/timestamps"))
    yield (
        "times backwards",
        hdf5(replaced("acquisition/torque/timestamps", lambda f, w: f.__setitem__(w, TIME_S[::-1]))),
    )
    yield "no version", hdf5(lambda f: f.attrs.__delitem__("nwb_version"))
    yield "nothing in it", hdf5(lambda f: f.__delitem__("acquisition"))
    yield "NaN", hdf5(lambda _: None, np.full(N, np.nan))
    yield "infinite", hdf5(lambda _: None, np.full(N, np.inf))
    yield "too many objects", hdf5(lambda f: [f.create_group(f"acquisition/g{k}") for k in range(600)] and None)

    def truncated(folder: Path) -> Path:
        path = hdf5(lambda _: None)(folder)
        path.write_bytes(path.read_bytes()[:9000])
        return path

    yield "truncated", truncated


def written(name: str, content: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return make


def tables() -> Iterator[tuple[str, Callable[[Path], Path]]]:
    def table(columns: dict[str, object], keep: int | None = None) -> Callable[[Path], Path]:
        def make(folder: Path) -> Path:
            pq.write_table(pa.table(columns), folder / "x.parquet")
            (folder / "x.parquet").write_bytes((folder / "x.parquet").read_bytes()[:keep])
            return folder / "x.parquet"

        return make

    yield "truncated table", table({"time_s": TIME_S, "torque": TIME_S, "width": WIDTHS}, 3000)
    yield "no times", table({"torque": TIME_S, "width": WIDTHS})
    yield "texts", table({"time_s": ["a"] * 10, "torque": ["b"] * 10})
    yield "no row", table({"time_s": np.empty(0), "torque": np.empty(0)})
    yield "twice", table({"time_s": np.zeros(N), "torque": TIME_S, "width": WIDTHS})
    yield "only the magic", written("x.parquet", b"PAR1" * 4)
    deep = b'{"resourceType": "Bundle", "a": ' + b"[" * 5000
    yield "deep", written("x.json", deep)
    sampled = {"origin": {"value": 0, "code": "N.m"}, "period": 10, "dimensions": 1, "data": "1 2 x"}
    parts = [{"code": {"text": name}, "valueSampledData": sampled} for name in ("torque", "width")]
    document = {"resourceType": "Observation", "component": parts}
    yield "words for numbers", written("x.json", json.dumps(document).encode())
    yield "no observation", written("x.json", b'{"resourceType": "Bundle", "entry": []}')
    yield "entries of nothing", written("x.json", b'{"resourceType": "Bundle", "entry": [1, null]}')
    sampled["data"], sampled["period"] = "1 2 3", 0
    yield "no period", written("x.json", json.dumps(document).encode())
    yield "no format", written("x.bin", b"\0" * 100)
    yield "empty", written("x.nwb", b"")
    yield "a table", written("x.csv", b"time_s,torque_nm\n0,0\n")


def packed() -> Iterator[tuple[str, Callable[[Path], Path]]]:
    def bids(content: bytes | None = None, head: object = None) -> Callable[[Path], Path]:
        def make(folder: Path) -> Path:
            path = foreign_files.bids(folder, {"torque": np.sin(TIME_S), "width": WIDTHS}, {"torque": "N.m"}, 100.0)
            if content is not None:
                path.write_bytes(content)
            if head is not None:
                path.with_name(path.name.replace(".tsv.gz", ".json")).write_text(json.dumps(head))
            return path

        return make

    yield "no gzip", bids(b"1\t2\n")
    yield "a bomb", bids(gzip.compress(b"1\t2\n" * 10**6))
    yield "cut", bids(gzip.compress(b"1\t2\n" * 100)[:-9])
    yield "words", bids(gzip.compress(b"1\tten\n" * 100))
    yield "a cell too many", bids(gzip.compress(b"1\t2\t3\n" * 100))
    yield "no columns", bids(None, {"SamplingFrequency": 100})
    yield "no rate", bids(None, {"SamplingFrequency": 0, "StartTime": 0, "Columns": ["torque", "width"]})
    yield "a rate of text", bids(None, {"SamplingFrequency": "often", "StartTime": 0, "Columns": ["torque", "width"]})
    streams = [
        Stream("torque", "T", 100.0, (("a", "Nm"),), TIME_S, np.sin(TIME_S)[:, None]),
        Stream("width", "P", 100.0, (("a", "us"),), TIME_S, WIDTHS[:, None]),
    ]
    sound = foreign_files.xdf(streams)
    head = sound[: sound.index(b"\x03\x00") - 5]
    yield "samples that are not there", written("x.xdf", head + chunk(3, struct.pack("<IBQ", 1, 8, 2**60)))
    yield "no stream", written("x.xdf", b"XDF:")
    yield "a chunk without a length", written("x.xdf", b"XDF:\x07abc")
    yield "declarations", written("x.xdf", sound.replace(b"<info><name>torque", b"<!DOCTYPE a><info><name>torque", 1))
    many = sound.replace(b"<channel_count>1<", b"<channel_count>999999999<", 1)
    yield "channels without end", written("x.xdf", many)
    yield "a rate of text", written("x.xdf", sound.replace(b"<nominal_srate>100.0<", b"<nominal_srate>often<", 1))


ALL = [*nwbs(), *tables(), *packed()]


def test_sound_ones_are_taken(tmp_path: Path) -> None:
    """What the hostile ones are made of is no reason to refuse them."""
    path = hdf5(lambda _: None)(tmp_path)
    assert main.run(["import", str(path), "-o", str(tmp_path / "out.csv"), *ANSWERS]) == 0
    link = hdf5(replaced("acquisition/width/timestamps", lambda f, w: f.__setitem__(
        w, h5py.SoftLink("/acquisition/torque/timestamps"))))(tmp_path)  # fmt: skip
    assert main.run(["import", str(link), "-o", str(tmp_path / "out.csv"), *ANSWERS]) == 0, "links within are common"


@pytest.mark.parametrize(("name", "make"), ALL, ids=[f"{k}-{name}" for k, (name, _) in enumerate(ALL)])
def test_each_is_refused_in_one_line(
    name: str, make: Callable[[Path], Path], tmp_path: Path, capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(bids_in, "LARGEST_FILE_BYTES", 2**20)  # a bomb of 4 MB is one then
    path = make(tmp_path)
    code = main.run(["import", str(path), "-o", str(tmp_path / "out.csv"), *ANSWERS])
    said = capfd.readouterr().err
    lines = [line for line in said.splitlines() if line.startswith("stimrig")]
    assert code == 2 and len(lines) == 1, said
    assert "unexpected" not in said and len(lines[0]) < 600 and lines[0].endswith((".", ")")), said
    assert SECRET not in said and not (tmp_path / "out.csv").exists()


def test_what_is_packed_small_is_bounded_by_what_it_is_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Constant columns take next to nothing in a file; many series, each of them small enough, add up."""
    table, many = tmp_path / "x.parquet", hdf5(lambda _: None)(tmp_path)
    same = {f"c{k}": np.zeros(20_000) for k in range(40)}
    pq.write_table(pa.table({"time_s": np.arange(20_000) / 100, "torque": np.zeros(20_000), **same}), table)
    monkeypatch.setattr(parquet_in, "UNPACKED_BYTES", 10 * table.stat().st_size)
    monkeypatch.setattr(nwb_in, "MOST_NUMBERS", N)
    for path in (table, many):
        assert main.run(["import", str(path), "-o", str(tmp_path / "out.csv"), *ANSWERS]) == 2
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "content", "needed"), [("x.xdf", b"XDF:", "pyxdf"), ("x.parquet", b"PAR1", "pyarrow")]
)
def test_without_a_library_it_says_what_to_install(
    name: str, content: bytes, needed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    for module in [one for one in sys.modules if one.partition(".")[0] == needed]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, needed, None)
    (tmp_path / name).write_bytes(content)
    assert main.run(["import", str(tmp_path / name), "-o", str(tmp_path / "out.csv")]) == 2
    assert "pip install stimrig[files]" in capsys.readouterr().err


def test_a_cut_stream_is_taken_as_far_as_it_goes_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    streams = [
        Stream("torque", "T", 100.0, (("a", "Nm"),), TIME_S, np.sin(TIME_S)[:, None]),
        Stream("width", "P", 100.0, (("a", "us"),), TIME_S, WIDTHS[:, None]),
    ]
    (tmp_path / "x.xdf").write_bytes(foreign_files.xdf(streams[::-1])[:-5000])
    command = ["import", str(tmp_path / "x.xdf"), "-o", str(tmp_path / "out.csv"), *ANSWERS, "--json"]
    assert main.run(command) == 0
    assert any("ends in the middle" in note for note in json.loads(capsys.readouterr().out)["notes"])

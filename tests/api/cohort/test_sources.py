"""Folders and buckets (in memory; with S3 by moto's server): what they list and open, what is wrong with them."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import fsspec
import pytest

from stimrig.api.cohort.select import FIELDS, Selection
from stimrig.api.cohort.sources import Bucket, Entry, Folder, Source, SourceError, sources_of
from stimrig.api.cohort.tasks import CohortError

pytestmark = pytest.mark.slow

MOST = 1000


def listed(source: Source) -> list[Entry]:
    return sorted(source.entries(), key=lambda entry: entry.address)


def refused(*addresses: str) -> str:
    with pytest.raises(CohortError) as caught:
        for source in sources_of(addresses):
            source.check()
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- folders


def test_a_folder_lists_records_and_nothing_else(tmp_path: Path) -> None:
    for name in ("a.h5", "sub/b.CSV", "sub/deeper/c.mat", ".hidden.h5", ".git/d.h5", "notes.pdf", "_part.csv", "e"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "gone.h5").symlink_to(tmp_path / "nowhere")
    (tmp_path / "round").symlink_to(tmp_path)
    found = listed(Folder(str(tmp_path)))
    assert [entry.name for entry in found] == ["a.h5", "b.CSV", "c.mat"]
    assert found[0].known == {"name": "a.h5", "origin": str(tmp_path), "bytes": 4}
    assert Folder(str(tmp_path)).open(found[0], MOST) == b"a.h5"
    assert len(Folder(str(tmp_path)).open(found[0], 2)) == 3


def test_the_tables_of_an_export_are_no_records(tmp_path: Path) -> None:
    (tmp_path / "P1_a.csv").write_text("a")
    (tmp_path / "records.csv").write_text("r")
    for source in (Folder(str(tmp_path)), Bucket(f"file://{tmp_path}")):
        assert [entry.name for entry in listed(source)] == ["P1_a.csv", "records.csv"], "a record may have this name"
    (tmp_path / "errors.csv").write_text("e")
    for source in (Folder(str(tmp_path)), Bucket(f"file://{tmp_path}")):
        assert [entry.name for entry in listed(source)] == ["P1_a.csv"]


def test_a_named_file_is_taken_whatever_its_name(tmp_path: Path) -> None:
    (tmp_path / "record.dat").write_bytes(b"x")
    assert [entry.name for entry in listed(Folder(str(tmp_path / "record.dat")))] == ["record.dat"]


def test_a_file_that_changes_has_another_stamp(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"x")
    before = listed(Folder(str(tmp_path)))[0].stamp
    os.utime(tmp_path / "a.h5", ns=(1, 1))
    assert listed(Folder(str(tmp_path)))[0].stamp != before


def test_a_name_that_is_no_utf8_can_be_read_and_told(tmp_path: Path) -> None:
    (Path(os.fsdecode(os.fsencode(tmp_path) + b"/a\xff.h5"))).write_bytes(b"x")
    (entry,) = listed(Folder(str(tmp_path)))
    assert entry.name.encode("utf-8")
    assert Folder(str(tmp_path)).open(entry, MOST) == b"x"


def test_a_file_that_went_is_told_when_it_is_opened(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"x")
    (entry,) = listed(Folder(str(tmp_path)))
    (tmp_path / "a.h5").unlink()
    with pytest.raises(SourceError, match="No such file"):
        Folder(str(tmp_path)).open(entry, MOST)


def test_a_folder_that_may_not_be_read_is_told_and_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "open").mkdir()
    (tmp_path / "open" / "a.h5").write_bytes(b"x")
    (tmp_path / "shut").mkdir()
    known = os.scandir

    def scandir(path: str) -> Any:  # whoever tests may be root, whom no rights keep out
        if str(path).endswith("shut"):
            raise PermissionError(13, "Permission denied")
        return known(path)

    monkeypatch.setattr(os, "scandir", scandir)
    found = listed(Folder(str(tmp_path)))
    assert [entry.name for entry in found] == ["a.h5", "shut"]
    with pytest.raises(SourceError, match="cannot be read"):
        Folder(str(tmp_path)).open(found[1], MOST)


def test_addresses_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    assert "no such file or folder" in refused(str(tmp_path / "nowhere"))
    assert "gibberish://" in refused("gibberish://x/y")
    assert "DATA is missing" in refused()


# ---- a bucket


@pytest.fixture(scope="module")
def bucket(s3: Any) -> Any:
    """Some objects."""
    s3.mkdir("records")
    for key, content in {"P1/a.h5": b"aaaa", "P1/b.csv": b"bb", "P2/c.h5": b"", "P2/readme.pdf": b"x"}.items():
        s3.pipe(f"records/{key}", content)
    return s3


def test_a_bucket_lists_and_opens_its_objects(bucket: Any) -> None:
    source = pickle.loads(pickle.dumps(Bucket("s3://records")))  # as it comes to a worker
    found = listed(source)
    assert [entry.address for entry in found] == [f"s3://records/{key}" for key in ("P1/a.h5", "P1/b.csv", "P2/c.h5")]
    assert [source.open(entry, MOST) for entry in found] == [b"aaaa", b"bb", b""]
    assert len(source.open(found[0], 2)) == 3
    assert all(entry.stamp for entry in found) and found[0].bytes == 4
    assert [entry.name for entry in listed(Bucket("s3://records/P2"))] == ["c.h5"]
    assert [entry.name for entry in listed(Bucket("s3://records/P1/a.h5"))] == ["a.h5"]


def test_objects_of_any_protocol_of_fsspec_are_listed_and_opened() -> None:
    fsspec.filesystem("memory").pipe({"/held/P1/a.h5": b"aaaa", "/held/readme.pdf": b"x"})
    (entry,) = listed(Bucket("memory://held"))
    assert (entry.address, entry.bytes) == ("memory:///held/P1/a.h5", 4)
    assert Bucket("memory://held").open(entry, MOST) == b"aaaa"
    assert "memory://nowhere" in refused("memory://nowhere")


def test_an_object_that_changes_has_another_stamp(bucket: Any) -> None:
    before = listed(Bucket("s3://records/P1/b.csv"))[0]
    bucket.pipe("records/P1/b.csv", b"cc")
    assert listed(Bucket("s3://records/P1/b.csv"))[0].stamp != before.stamp
    bucket.rm("records/P1/b.csv")
    with pytest.raises(SourceError, match="cannot be fetched"):
        Bucket("s3://records").open(before, MOST)
    bucket.pipe("records/P1/b.csv", b"bb")


def test_a_bucket_that_is_not_there_is_refused_in_one_line(bucket: Any) -> None:
    assert "s3://nowhere" in refused("s3://nowhere")
    assert "s3://records/P9" in refused("s3://records/P9")


# ---- `--select`: what is meant, what is not known yet, what is refused, and that nothing is ever run


RECORD = {
    "participant": "P001", "day": "2026-03-01", "kind": "pre-session", "test_id": None, "name": "a calib.h5",
    "duration_s": 22.7, "bytes": 1000,
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("", True),
        ('participant == "P001"', True),
        ('participant in ("P001", "P002") and kind == "pre-session"', True),
        ('participant not in ["P001"]', False),
        ('participant != "P002"', True),
        ('day >= "2026-01-01" and day < "2026-03-01"', False),
        ('"2026-01-01" <= day', True),
        ("duration_s > 20 or bytes > 10", True),
        ("not (duration_s > 20)", False),
        ("20 < duration_s", True),
        ("duration_s > -1.5", True),
        ('"calib" in name', True),
        ('"calib" not in name', False),
        ("test_id == None", True),
        ('test_id == "T1"', False),
        ('test_id != "T1"', True),
        ('test_id > "T1"', False),
        ('"T" in test_id', False),
        ('kind == "x" or participant == "P001" and bytes < 1', False),
        ('not kind == "x" and participant\n  == "P001"', True),
    ],
)
def test_what_is_meant(text: str, meant: bool) -> None:
    assert Selection(text)(RECORD) is meant


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ('participant == "P001"', None),
        ('not participant == "P001"', None),
        ('name == "b" and participant == "P001"', False),
        ('name == "a" or participant == "P001"', True),
        ('name == "a" and participant == "P001"', None),
        ('name == "b" or participant == "P001"', None),
    ],
)
def test_what_is_open_before_the_record_is_read(text: str, meant: bool | None) -> None:
    assert Selection(text)({"name": "a"}) is meant


def refused_selection(text: str) -> str:
    with pytest.raises(CohortError) as caught:
        Selection(text)
    message = str(caught.value)
    assert "\n" not in message and message.startswith("--select")
    return message


def test_a_wrong_field_is_named_and_all_fields_are() -> None:
    message = refused_selection('patient == "P001"')
    assert "'patient'" in message
    assert all(field in message for field in FIELDS)


@pytest.mark.parametrize(
    "text",
    [
        '__import__("os").system("true")',
        'participant.__class__ == "x"',
        'participant == open("x")',
        "9**9**9 > bytes",
        "bytes == 1 == 1",
        "participant is None",
        "participant",
        '"a" == "b"',
        "participant == kind",
        "participant == True",
        "participant == 1",
        'duration_s > "20"',
        "duration_s in 3",
        "20 in duration_s",
        'day == "yesterday"',
        'day >= "2026-02-31"',
        "test_id > None",
        "bytes > 1j",
        "import os",
        "participant = 3",
        'participant == "P001"; import os',
        'participant == "P001',
        "participant == \0",
        "((((" * 500,
        "(" * 190 + 'participant == "P"' + ")" * 150,
        "not " * 400 + 'participant == "P"',
        "bytes > " + "-" * 1500 + "1",
        'participant == "P" or ' * 90 + "x",
        'participant == "' + "x" * 3000 + '"',
        'participant in {"a": 1}',
    ],
)
def test_what_is_no_comparison_of_fields_is_refused_in_one_line(text: str) -> None:
    refused_selection(text)

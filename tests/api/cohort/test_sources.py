"""List and read records in folders and buckets (in memory; with S3 by moto's server); select them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cohort import sources
from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.select import FIELDS, Selection, parse_day
from stimrig.api.cohort.sources import Entry, SourceError, count_records, list_records, read_content

pytestmark = pytest.mark.slow


def listed(*addresses: object) -> list[Entry]:
    return sorted(list_records([str(address) for address in addresses]), key=lambda entry: entry.address)


def names(*addresses: object) -> list[str]:
    return [entry.name for entry in listed(*addresses)]


def refusal(*addresses: str) -> str:
    with pytest.raises(CohortError) as caught:
        count_records(addresses)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_folder_lists_records_only(tmp_path: Path) -> None:
    for name in ("a.h5", "sub/b.CSV", "sub/deeper/c.mat", ".hidden.h5", ".git/d.h5", "notes.pdf", "_part.csv", "e"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "gone.h5").symlink_to(tmp_path / "nowhere")
    (tmp_path / "round").symlink_to(tmp_path)
    (tmp_path / "record.dat").write_bytes(b"x")
    entries = listed(tmp_path)
    assert [entry.name for entry in entries] == ["a.h5", "b.CSV", "c.mat"]
    assert entries[0].known == {"name": "a.h5", "origin": str(tmp_path), "bytes": 4}
    assert read_content(entries[0]) == b"a.h5"
    assert names(tmp_path / "record.dat") == ["record.dat"], "a file that is named itself may have any suffix"


@pytest.mark.parametrize("prefix", ["", "file://", "local://"])
def test_tables_of_an_export_are_no_records(tmp_path: Path, prefix: str) -> None:
    (tmp_path / "P1_a.csv").write_text("a")
    (tmp_path / "records.csv").write_text("r")
    assert names(f"{prefix}{tmp_path}") == ["P1_a.csv", "records.csv"], "a record may have this name"
    (tmp_path / "errors.csv").write_text("e")
    assert names(f"{prefix}{tmp_path}") == ["P1_a.csv"]


def test_stamp_changes_with_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"x")
    before = listed(tmp_path)[0].stamp
    os.utime(tmp_path / "a.h5", ns=(1, 1))
    assert listed(tmp_path)[0].stamp != before


def test_name_that_is_not_utf8(tmp_path: Path) -> None:
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/a\xff.h5")).write_bytes(b"x")
    (entry,) = listed(tmp_path)
    assert entry.name.encode("utf-8") and entry.address.encode("utf-8")
    assert read_content(entry) == b"x"


def test_file_that_was_removed_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"x")
    (entry,) = listed(tmp_path)
    (tmp_path / "a.h5").unlink()
    with pytest.raises(SourceError, match="No such file"):
        read_content(entry)


def test_file_that_is_too_large_is_not_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "LARGEST_FILE_BYTES", 3)
    (tmp_path / "a.h5").write_bytes(b"four")
    (entry,) = listed(tmp_path)
    for known in (entry.known, {"name": "a.h5"}):
        with pytest.raises(SourceError, match="MB") as caught:
            read_content(Entry(entry.address, entry.path, known=known))
        assert caught.value.kind == "bad record"


def test_folder_without_permission_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shut").mkdir()
    scan = os.scandir

    def scandir(path: Any) -> Any:  # the tests may run as root, whom no permission stops
        if str(path).endswith("shut"):
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert "shut: Permission denied" in refusal(str(tmp_path))


def test_unusable_addresses_are_refused(tmp_path: Path) -> None:
    assert "no such file or folder" in refusal(str(tmp_path / "nowhere"))
    assert "gibberish://" in refusal("gibberish://x/y")
    assert "DATA is missing" in refusal()


@pytest.fixture(scope="module")
def bucket(s3: Any) -> Any:
    """Some objects."""
    s3.mkdir("records")
    for key, content in {"P1/a.h5": b"aaaa", "P1/b.csv": b"bb", "P2/c.h5": b"", "P2/readme.pdf": b"x"}.items():
        s3.pipe(f"records/{key}", content)
    return s3


def test_bucket_lists_and_reads_its_objects(bucket: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    entries, keys = listed("s3://records"), ("P1/a.h5", "P1/b.csv", "P2/c.h5")
    assert [entry.address for entry in entries] == [f"s3://records/{key}" for key in keys]
    assert [read_content(entry) for entry in entries] == [b"aaaa", b"bb", b""]
    assert all(entry.stamp for entry in entries) and entries[0].known["bytes"] == 4
    assert names("s3://records/P2") == ["c.h5"] and names("s3://records/P1/a.h5") == ["a.h5"]
    bucket.pipe("records/P1/b.csv", b"cc")
    assert listed("s3://records/P1/b.csv")[0].stamp != entries[1].stamp
    bucket.rm("records/P1/b.csv")
    with pytest.raises(SourceError, match="cannot be read"):
        read_content(entries[1])
    assert "s3://nowhere" in refusal("s3://nowhere") and "s3://records/P9" in refusal("s3://records/P9")


# ---- --select


RECORD = {
    "participant": "P001", "day": parse_day("2026-03-01T10:00"), "kind": "pre-session", "test_id": None,
    "name": "a calib.h5", "duration_s": 22.7, "bytes": 1000,
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "selected"),
    [
        ("", True),
        ('participant in ("P001", "P002") and kind == "pre-session"', True),
        ('participant not in ("P001")', False),
        ('day >= "2026-01-01" and day < "2026-03-01"', False),
        ("duration_s > 20 or bytes > 10", True),
        ('not kind = "x" and participant\n  = "P001"', True),
        ('name not like "%calib%"', False),
        ("test_id is null", True),
        ('test_id > "T1"', False),
        ('test_id != "T1"', False),
    ],
)
def test_selection(text: str, selected: bool) -> None:
    assert Selection(text)(RECORD) is selected


@pytest.mark.parametrize(
    ("text", "selected"),
    [('participant = "P001"', None), ("test_id is not null", None), ('name = "b"', False), ('name = "a"', True)],
)
def test_selection_before_the_record_is_read(text: str, selected: bool | None) -> None:
    assert Selection(text)({"name": "a"}) is selected


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('patient = "P001"', ", ".join(FIELDS)),
        ('__import__("os").system("true")', "syntax"),
        ("(select load_extension(name))", "not authorized"),
        ("randomblob(1000000000) > bytes", "not authorized"),
        ("(with recursive x(n) as (select 1 union all select n from x) select n from x)", "not authorized"),
        ('participant == "P001"; select 1', "syntax"),
        ('participant == "P001', "unrecognized"),
        ("participant == \0", "null"),
        ("((((" * 500, "overflow"),
        ('participant == "\ud800"', "surrogates"),
        ('participant == "' + "x" * 3000 + '"', "2000 characters"),
    ],
)
def test_anything_else_is_refused_in_one_line(text: str, named: str) -> None:
    with pytest.raises(CohortError, match=r"^--select") as caught:
        Selection(text)
    assert "\n" not in str(caught.value) and named in str(caught.value)

"""Results on disk: whole or not there, resumable, no row twice, none lost."""

from __future__ import annotations

import hashlib
import json
import os
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stimrig.api.cohort import results, sources, table
from stimrig.api.cohort.errors import CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.select import FIELDS, Selection, parse_day
from stimrig.api.cohort.sources import Entry, SourceError, count_records, list_records, read_content
from stimrig.api.cohort.task import Task

pytestmark = pytest.mark.slow

TASK = Task("fit", software="1.0")


def row(name: str, content: str | None = None, status: str = "ok", **more: Any) -> dict[str, Any]:
    sha256 = None if content == "" else hashlib.sha256((content or name).encode()).hexdigest()
    keys = {"address": f"/d/{name}", "name": name, "stamp": f"s-{content or name}", "sha256": sha256, "bytes": 3}
    return {**keys, "status": status, **more}


def failure(name: str, kind: str, content: str | None = None) -> dict[str, Any]:
    return row(name, content, "error", error_kind=kind)


def entry(name: str, content: str | None = None) -> Entry:
    return Entry(f"/d/{name}", name, stamp=f"s-{content or name}", known={"name": name, "bytes": 3})


def written(output: Path) -> list[str]:
    """The rows, which are in the order of their addresses."""
    return [f"{row['name']} {row['status']}" for row in pq.read_table(output).to_pylist()]


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "results.parquet"


def run(output: Path, *rows: dict[str, Any], join: bool = True, **options: Any) -> None:
    with Results(output, TASK, **options) as results:
        for one in rows:
            results.add(one)
        if join:
            results.join()


def refuse(output: Path, match: str, task: Task = TASK) -> None:
    with pytest.raises(CohortError, match=match) as caught, Results(output, task):
        pass
    assert "\n" not in str(caught.value)


def test_interrupted_run_resumes(output: Path) -> None:
    run(output, row("a"), failure("b", "bad record"), row("c", status=LEFT_OUT), join=False)
    assert not output.exists()
    with Path(f"{output}.rows").open("ab") as file:
        file.write(b'{"address": "/d/d", "sta')  # the process was killed as it wrote
    with Results(output, TASK) as results:
        assert [results.has(entry(name)) for name in "abcd"] == [True, True, False, False]
        assert not results.has(entry("a", "changed"))
        results.add(row("d"))
        assert results.join() == {"ok": 2, "error": 1}
    assert not results.journal.exists()
    run(output, row("e"))
    assert written(output) == ["a ok", "b error", "d ok", "e ok"], "what is new is added to finished results"


def test_run_that_did_nothing_leaves_nothing(output: Path) -> None:
    with Results(output, TASK) as results:
        assert results.journal.exists()
    assert list(output.parent.iterdir()) == []


def test_a_refused_output_is_left_as_it_was(output: Path) -> None:
    output.write_bytes(b"a recording")
    refuse(output, "no results of `stimrig cohort`")
    refuse(Path("/dev/null"), "a folder or a device. Give a file")
    refuse(output.parent / "absent" / "r.parquet", "Give a file in a folder that can be written")
    assert list(output.parent.iterdir()) == [output] and output.read_bytes() == b"a recording"


def test_killed_between_joining_and_removing_the_lines(output: Path) -> None:
    run(output, row("a"), failure("b", "timeout"), join=False)
    lines = Path(f"{output}.rows").read_bytes()
    run(output)
    Path(f"{output}.rows").write_bytes(lines)
    run(output)
    assert written(output) == ["a ok", "b error"]


def test_full_disk_keeps_the_lines(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(output, row("a"), join=False)
    with Results(output, TASK) as results, monkeypatch.context() as patch:
        patch.setattr(pq.ParquetWriter, "write_table", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
        with pytest.raises(InterruptedRunError, match="No space left"):
            results.join()
    assert not output.exists()
    run(output)
    assert written(output) == ["a ok"]


def test_content_counts_once_and_the_newest_row_of_an_address(output: Path) -> None:
    run(output, row("a", "x"), row("b", "x"), row("c", "old"))
    assert written(output) == ["a copy", "b ok", "c ok"]
    for _ in range(2):
        run(output, row("b", "y"), row("c", "new"))
        assert written(output) == ["a ok", "b ok", "c ok"], "the content of a lies elsewhere no more"
        assert {row["stamp"] for row in pq.read_table(output).to_pylist()} == {"s-x", "s-y", "s-new"}


def test_transient_errors_are_repeated_if_asked(output: Path) -> None:
    run(output, failure("slow", "timeout"), failure("far", "unreadable", ""), failure("bad", "bad record"))
    with Results(output, TASK) as results:
        assert results.has(entry("slow"))
    with Results(output, TASK, again=True) as results:
        assert not results.has(entry("slow")) and results.has(entry("bad"))
    run(output, row("slow"), row("far"), again=True)
    assert written(output) == ["bad error", "far ok", "slow ok"]


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (Task("diagnose", software="1.0"), "verb fit, now diagnose"),
        (Task("fit", software="2.0"), "software 1.0, now 2.0"),
        (Task("fit", effects=("fatigue",), software="1.0"), "effects none, now fatigue"),
        (Task("fit", 'rig == "R"', software="1.0"), "select none"),
    ],
)
@pytest.mark.parametrize("join", [False, True])
def test_other_options_are_refused(output: Path, other: Task, named: str, join: bool) -> None:
    run(output, row("a"), join=join)
    refuse(output, named, other)


def test_two_runs_never_write_one_output(output: Path) -> None:
    with Results(output, TASK):
        refuse(output, "another run")


def test_a_damaged_line_is_refused(output: Path) -> None:
    run(output, row("a"), join=False)
    Path(f"{output}.rows").write_bytes(b"letter\n")
    refuse(output, "damaged")


EMPTY = table.SCHEMA.empty_table()


@pytest.mark.parametrize(
    ("content", "about"),
    [
        (None, {}),
        (pa.table({"a": [1]}), {}),
        (pa.table({"a": [1]}), {"format": table.FORMAT, "options": "{}"}),
        (pa.table({name: ["x"] for name in table.SCHEMA.names}), {"format": table.FORMAT, "options": "{}"}),
        (EMPTY, {"format": table.FORMAT, "options": "[" * 100_000}),
        (EMPTY, {"format": table.FORMAT, "options": "[1]"}),
    ],
    ids=["letter", "other table", "other columns", "texts", "deep", "no object"],
)
def test_other_files_are_never_overwritten(output: Path, content: Any, about: dict[str, str]) -> None:
    if content is None:
        output.write_bytes(b"somebody's letter")
    else:
        pq.write_table(content.replace_schema_metadata(about), output)
    before = output.read_bytes()
    refuse(output, r"results\.parquet: no results of")
    assert output.read_bytes() == before


def test_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    refuse(tmp_path, "a folder")
    (tmp_path / "file").write_text("")
    refuse(tmp_path / "file" / "r.parquet", "Give a file in a folder")


def test_many_rows_are_written_in_groups(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "GROUP_ROWS", 10)
    monkeypatch.setattr(table, "BATCH_ROWS", 4)
    run(output, *(row(str(number % 50), status="ok" if number % 3 else LEFT_OUT) for number in range(60)))
    assert written(output) == sorted({f"{number % 50} ok" for number in range(60) if number % 3})
    assert pq.read_metadata(output).num_row_groups > 2


def test_columns_have_types_and_units(output: Path) -> None:
    time_utc = datetime(2026, 2, 1, tzinfo=UTC)
    parameter = {"of": "model", "name": "damping", "value": 1, "sd": None, "unit": "1", "more": "dropped"}
    run(output, row("a", day=date(2026, 1, 31), computed_utc=time_utc, parameters=[parameter], took_s=0.5, nobody=1))
    found = pq.read_table(output)
    assert found.schema.field("rms_nm").metadata[b"unit"] == "N·m".encode()
    assert all(field.metadata[b"description"] for field in found.schema)
    assert json.loads(found.schema.metadata[b"options"]) == TASK.options()
    (stored,) = found.to_pylist()
    assert (stored["day"], stored["computed_utc"]) == (date(2026, 1, 31), time_utc)
    assert stored["parameters"][0]["value"] == 1.0


@pytest.mark.parametrize("nonsense", [{"kind": "\ud800"}, {"rate_hz": "fast"}, {"rate_hz": 2**2000}, {"begun_utc": {}}])
def test_row_that_cannot_be_stored_is_an_error(nonsense: dict[str, Any]) -> None:
    found = table.rows_to_table([row("a"), {**row("b"), **nonsense}]).to_pylist()
    assert [one["status"] for one in found] == ["ok", "error"]
    assert found[1]["address"] == "/d/b" and found[1]["error_kind"] == "unexpected" and found[1]["error"]


# ---- List and read records in folders and buckets (in memory; with S3 by moto's server); select them.


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

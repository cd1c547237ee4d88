"""Results on disk: whole or not there, resumable, no row twice, none lost."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stimrig.api.cohort import results, table
from stimrig.api.cohort.errors import CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.sources import Entry
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

"""Tables that say they are results and are none: one line each."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from api.cohort.errors import CohortError
from api.cohort.read import options_of
from api.cohort.table import FORMAT, FORMAT_VERSION, SCHEMA

EMPTY = SCHEMA.empty_table()
TABLES = {
    "other-columns": (pa.table({"a": [1]}), b"{}"),
    "texts": (pa.table({name: ["x"] for name in SCHEMA.names}), b"{}"),
    "numbers": (pa.table({name: [2**62] for name in SCHEMA.names}), b"{}"),
    "deep": (EMPTY, b"[" * 100_000),
    "no-object": (EMPTY, b"[1]"),
}


@pytest.mark.parametrize("name", TABLES)
def test_it_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    table, options = TABLES[name]
    about = {b"format": FORMAT.encode(), b"format_version": FORMAT_VERSION.encode(), b"options": options}
    pq.write_table(table.replace_schema_metadata(about), tmp_path / "r.parquet")
    with pytest.raises(CohortError, match=r"r\.parquet: ") as caught:
        options_of(tmp_path / "r.parquet")
    assert "\n" not in str(caught.value)

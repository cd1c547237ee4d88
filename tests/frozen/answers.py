"""Calls the command line, condenses what it gives, and compares two of these."""

from __future__ import annotations

import contextlib
import csv
import html
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from stimrig.api.cli import main

HERE = Path(__file__).resolve().parents[2]
NUMBER = re.compile(r"[-−+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
LONG = 12
"""Of longer rows of numbers only their shape, ends and moments are kept."""
VOLATILE = (
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d[.\d]*(?:\+00:00|Z)?"), "<time>"),
    (re.compile(r"\bm-[0-9a-f]{6,}\b|\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f-]{22}\b"), "<id>"),
    (re.compile(r"\b[0-9a-f]{64}\b"), "<digest>"),
    (re.compile(r"stimrig-error-\d+"), "stimrig-error-<id>"),
    (
        re.compile(
            r"\b(look|test|again|running|identifying|done|asked|calibrate|calibrating|wait|rearm|trial) [0-9a-f]{8}\b"
        ),
        r"\1 <id>",
    ),
    (re.compile(r"(done before, |in )\d+(?:\.\d+)? m?s\b"), r"\1<duration>"),
    (re.compile(r"(stimrig_rig_|Model )(?:[\w-]{30,}|[0-9a-f]{8}\b)"), r"\1<id>"),
    (re.compile(r"\b(?:stimrig )?\d+\.\d+\.\d+(?:[.+]\w+)*\b"), "<version>"),
    (re.compile(r"\b(?:stimrig\.)?((?:identify|api|rig|hardware_sim)\.[a-z_.]+)"), r"\1"),
)
NEW_EACH_TIME = {"model_id", "created", "software", "elapsed_s", "took_s", "age_s", "torque_age_s", "uptime_s"}


@contextlib.contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Calls of the command line work in this folder, in UTC and on lines of 100 characters."""
    environment = {"PYTHONPATH": str(HERE), "COLUMNS": "100", "OPENBLAS_NUM_THREADS": "1", "TZ": "UTC"}
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("STIMRIG_")]:
            patch.delenv(name)
        for name, value in environment.items():
            patch.setenv(name, value)
        patch.chdir(folder)
        time.tzset()
        yield
    time.tzset()


def call(line: str) -> dict[str, Any]:
    """Exit code, standard output and error of a call, and every file that is new in the working folder after it."""
    folder = Path.cwd()
    before = _files(folder)
    done = run(line)
    new = [path for path, changed in _files(folder).items() if before.get(path) != changed]
    answer = {
        "exit": done["exit"],
        "out": _text(done["out"], folder),
        "error": _text(done["error"], folder) if done["exit"] else "",  # else progress
        "files": {_plain(str(path.relative_to(folder)), folder): condensed_file(path, folder) for path in sorted(new)},
    }
    for name, document in answer["files"].items():
        if document == answer["out"]:
            answer["out"] = f"<as {name}>"
    return answer


def run(line: str) -> dict[str, Any]:
    """Exit code, standard output and error as they are; in this process, but for the emulator."""
    if line.startswith("emulate"):  # which becomes another program
        command = [sys.executable, "-m", "stimrig", *line.split()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=900)
        return {"exit": done.returncode, "out": done.stdout, "error": done.stderr}
    before = os.dup(1), os.dup(2)
    with (
        tempfile.TemporaryFile("w+") as out,
        tempfile.TemporaryFile("w+") as error,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr("sys.argv", ["stimrig", *line.split()])
        os.dup2(out.fileno(), 1), os.dup2(error.fileno(), 2)  # of children, too
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
                code = main.run(line.split())
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            os.dup2(before[0], 1), os.dup2(before[1], 2)
            os.close(before[0]), os.close(before[1])
        texts = []
        for file in (out, error):
            file.seek(0)
            texts.append(file.read())
    return {"exit": code, "out": texts[0], "error": texts[1]}


def _files(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def _text(text: str, folder: Path) -> Any:
    try:
        return condensed(json.loads(text), folder)
    except ValueError:
        return words_of(text, folder) if "<div" in text else [_plain(line, folder) for line in text.split("\n")]


def _plain(text: str, folder: Path) -> str:
    text = text.replace(str(folder), "<folder>")
    for pattern, word in VOLATILE:
        text = pattern.sub(word, text)
    return text


def condensed(value: Any, folder: Path, key: str = "") -> Any:
    """A document without what differs from call to call, its long rows of numbers as shape, ends and moments."""
    if key in NEW_EACH_TIME:
        return "<new each time>"
    if isinstance(value, dict):
        return {_plain(str(name), folder): condensed(one, folder, name) for name, one in value.items()}
    if isinstance(value, list):
        if len(value) > 4 and all(isinstance(one, dict) and one.keys() == value[0].keys() for one in value):
            return {f"{name}[]": condensed([one[name] for one in value], folder, name) for name in value[0]}
        try:
            numbers = np.asarray(value, float)
        except (ValueError, TypeError):
            return [condensed(one, folder) for one in value]
        return _row(numbers) if numbers.size > LONG else [condensed(one, folder) for one in value]
    if isinstance(value, float):
        return _short(value)
    return _plain(value, folder) if isinstance(value, str) else value


def _row(numbers: np.ndarray) -> dict[str, Any]:
    flat = numbers.ravel()[np.isfinite(numbers.ravel())]
    if not flat.size:
        return {"shape": list(numbers.shape), "known": 0}
    weights = 1 + (np.arange(flat.size) * 0.618034) % 1  # so that an exchange of two shows
    return {
        "shape": list(numbers.shape), "known": int(flat.size), "ends": [_short(flat[0]), _short(flat[-1])],
        "rms": _short(np.sqrt(np.mean(flat**2))), "mean": _short(flat.mean()),
        "weighted": _short(np.sqrt(np.mean(weights * flat**2))),
    }  # fmt: skip


def _short(number: float) -> float:
    return float(f"{number:.6g}")


def condensed_file(path: Path, folder: Path) -> Any:
    """What a file holds."""
    if path.suffix in (".json", ".jsonl") or not path.stat().st_size:
        return _text(path.read_text("utf-8", "replace"), folder)
    if path.suffix == ".csv":
        return _table(path, folder)
    if path.suffix == ".parquet":
        return condensed(json.loads(json.dumps(pq.read_table(path).to_pydict(), default=str)), folder)
    if path.suffix == ".h5" and h5py.is_hdf5(path):
        return _hdf5(path, folder)
    if path.suffix in ("", ".html"):
        return words_of(path.read_text("utf-8", "replace"), folder)
    return f"<{path.suffix} file>"


def _hdf5(path: Path, folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def look(name: str, one: Any) -> None:
        attributes = {key: _plain(str(value), folder) for key, value in sorted(one.attrs.items())}
        found[name] = {"attributes": attributes | ({"software": "<new each time>"} if "software" in attributes else {})}
        if isinstance(one, h5py.Dataset):
            text = h5py.check_string_dtype(one.dtype) is not None
            column = [str(word) for word in one.asstr()[:]] if text else np.asarray(one, float)
            found[name] |= {"type": str(one.dtype), "column": column if text else _row(np.asarray(column))}

    with h5py.File(path) as file:
        look("/", file)
        file.visititems(look)
    return found


def words_of(page: str, folder: Path) -> list[str]:
    """The texts of a page, one each."""
    shown = re.sub(r"(?s)<(script|style|svg)\b.*?</\1>", "<>", page)
    texts = (html.unescape(text) for text in re.split(r"<[^>]*>", shown))
    return [_plain(" ".join(text.split()), folder) for text in texts if text.strip()]


def _table(path: Path, folder: Path) -> Any:
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        head, *rows = list(csv.reader(file)) or [[]]
    columns = dict(zip(head, zip(*rows, strict=False), strict=False))
    return {"rows": len(rows)} | {name: _column(list(values), folder) for name, values in columns.items()}


def _column(values: list[str], folder: Path) -> Any:
    try:
        return _row(np.asarray(values, float))
    except ValueError:
        return sorted({_plain(one, folder) for one in values})[:20]


WEAK = "as_real|as_gap|as_start|arm_moving|sealed_400|rig_stopped|rig_adaptive|rig_trial|rig_calibration"
"""Recordings that say too little, or too much that no model explains: an older processor moves their answers, too."""
LOOSE: tuple[tuple[str, float, float], ...] = (
    ("", 1e-4, 1e-9),
    (r"/candidates/.*/(forms|log_evidence_gain|rms_nm)\[\]/", 0.01, 0.05),  # of two log evidences of thousands
    ("/sd$", 1e-3, 1e-9),  # of second differences
    (f"/({WEAK})/(?!recording/)", 0.05, 0.01),
    ("/(processor_s|worker_memory_mb)/", 1.0, 0.0),  # the machine's
)
"""Pattern of a place, and how much a number there may differ: relative, absolute. The last that fits counts."""


def differences(kept: Any, now: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """Each place where two answers are not equal, and what is there; a document in a text is compared as one."""
    if isinstance(kept, str) and isinstance(now, str) and kept[:2] == now[:2] == '{"':
        kept, now = json.loads(kept), json.loads(now)
    if isinstance(kept, dict) and isinstance(now, dict):
        for name in sorted({*kept, *now}):
            if name not in kept or name not in now:
                yield f"{place}/{name}", f"new: {str(now[name])[:200]!r}" if name in now else "gone"
            else:
                yield from differences(kept[name], now[name], f"{place}/{name}")
    elif isinstance(kept, list) and isinstance(now, list) and len(kept) == len(now):
        for k, (one, other) in enumerate(zip(kept, now, strict=True)):
            yield from differences(one, other, f"{place}/{k}")
    elif isinstance(kept, list) and isinstance(now, list):
        k = next((k for k, (one, other) in enumerate(zip(kept, now, strict=False)) if one != other), len(kept))
        yield f"{place}/{k}", f"was {len(kept)} with {str(kept[k:])[:300]}, is {len(now)} with {str(now[k:])[:300]}"
    elif not _same(kept, now, place):
        yield place, f"was {str(kept)[:300]!r}, is {str(now)[:300]!r}"


def _same(kept: Any, now: Any, place: str) -> bool:
    """Numbers may differ by 1e-4 of their size, also those in a text, and there by one in their last digit."""
    if isinstance(kept, str) and isinstance(now, str):
        numbers = NUMBER.findall(kept), NUMBER.findall(now)
        if NUMBER.sub("#", kept) != NUMBER.sub("#", now) or len(numbers[0]) != len(numbers[1]):
            return False
        pairs = ((one.replace("−", "-"), other.replace("−", "-")) for one, other in zip(*numbers, strict=True))
        return all(one == other or _close(float(one), float(other), place, one) for one, other in pairs)
    plain = isinstance(kept, int | float) and isinstance(now, int | float)
    if plain and not isinstance(kept, bool) and not isinstance(now, bool):
        return _close(float(kept), float(now), place)
    return type(kept) is type(now) and kept == now


def _close(one: float, other: float, place: str, written: str = "") -> bool:
    _, relative, absolute = next(loose for loose in reversed(LOOSE) if re.search(loose[0], place))
    last = 10.0 ** -len(written.partition(".")[2]) if "." in written and "e" not in written else 0.0
    known = one == other or (np.isnan(one) and np.isnan(other))
    return bool(known or abs(one - other) <= max(relative * max(abs(one), abs(other)), absolute, 1.01 * last))

"""Every file that we write, we read: each kind of recording of the rig through each verb that takes recordings."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.cli import main
from stimrig.identify.errors import BadRecord
from tests.frozen.rig_records import KINDS, of_kind
from tests.harness import few_effects

pytestmark = pytest.mark.slow

TOO_LITTLE = {
    "calibration": "a handful of pulses of one width",
    "passive": "no pulse at all",
    "stopped": "it ended before its ramp",
}
"""Kinds of which no model can be made, and why: a verb says so in one line."""
SEALED = [kind for kind in KINDS if kind != "journal"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of every kind; of a calibration the first train."""
    place = tmp_path_factory.mktemp("kinds")
    for kind in KINDS:
        for number, (name, data) in enumerate(sorted(of_kind(kind).items())):
            if name.endswith((".h5", ".journal")) and not (kind == "calibration" and number > 1):
                (place / f"{kind}{Path(name).suffix}").write_bytes(data)
    return place


@pytest.fixture(autouse=True)
def small_library() -> Iterator[None]:
    with few_effects.only("fatigue", "output_saturation"):
        yield


def run(*words: object) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.run(list(map(str, words)))
    return code, out.getvalue(), err.getvalue()


def done(*words: object) -> str:
    code, out, err = run(*words)
    assert code == 0, err
    return out


@pytest.mark.parametrize("kind", [kind for kind in SEALED if kind not in TOO_LITTLE])
def test_each_verb_takes_each_kind(folder: Path, tmp_path: Path, kind: str) -> None:
    data, model, table = folder / f"{kind}.h5", tmp_path / "MODEL.json", tmp_path / "predicted.csv"
    done("fit", data, "-o", model)
    done("predict", model, data, "-o", table)
    done("compare", model, data, *(["--html", tmp_path / "c.html"] if kind in ("plain", "moving") else []))
    if kind == "moving":  # the longest verb, with an angle; of a plain one tests/api/test_readme.py runs it
        told = json.loads(done("explain", data, "--html", tmp_path / "s.html", "-o", model, "--json"))
        assert told["diagnosis"]["verdict"] and (tmp_path / "s.html").stat().st_size > 10_000
    predicted = np.genfromtxt(table, delimiter=",", names=True)
    assert predicted.dtype.names == ("time_s", "torque_nm", "predicted_torque_nm") and len(predicted) > 100


@pytest.mark.parametrize("kind", sorted(TOO_LITTLE))
def test_what_holds_too_little_is_read_and_refused_in_one_line(folder: Path, kind: str) -> None:
    data = folder / f"{kind}.h5"
    with contextlib.suppress(BadRecord):  # a train of a calibration may be shorter than any record
        identify.read(data)
    for verb in ("fit", "explain"):
        code, out, err = run(verb, data)
        assert code in (0, 2) and (code == 0 or (out == "" and err.count("\n") == 1 and str(data) in err)), err


@pytest.mark.parametrize("way", ["csv", "mat", "parquet"])
def test_every_kind_is_exported(folder: Path, tmp_path: Path, way: str) -> None:
    told = json.loads(done("export", folder, "-o", tmp_path / "out", "--format", way, "--json"))
    assert told["errors"] == 0, (tmp_path / "out" / "errors.csv").read_text()
    assert told["records"] == len(SEALED)


def test_a_long_plan_is_no_reason_to_refuse_a_recording(folder: Path, tmp_path: Path) -> None:
    """A test that stops itself has hundreds of segments in `configuration`: its export was refused."""
    data = tmp_path / "long.h5"
    data.write_bytes((folder / "adaptive.h5").read_bytes())
    with h5py.File(data, "r+") as file:
        plan = json.dumps({"segments": [{"name": "prbs", "settings": {"width_us": list(range(300))}}] * 200})
        file.attrs["configuration"] = plan
    told = json.loads(done("export", data, "-o", tmp_path / "out", "--json"))
    assert (told["records"], told["errors"]) == (1, 0)
    done("fit", data)


def test_a_verb_that_did_nothing_of_what_was_asked_does_not_end_well(folder: Path, tmp_path: Path) -> None:
    bad = tmp_path / "in" / "bad.h5"
    bad.parent.mkdir()
    bad.write_bytes(b"\x89HDF\r\n\x1a\nand nothing more")
    code, _out, err = run("export", "-o", tmp_path / "out", bad.parent)
    assert code == 1 and "nothing was done" in err and err.count("\n") <= 2, err
    nobodys = ("--select", "participant = 'nobody'", folder / "plain.h5")
    code, _out, err = run("export", "-o", tmp_path / "other", *nobodys)
    assert code == 1 and "no record" in err

"""The process that computes: whatever a record does to it is a row, and the next record is computed."""

from __future__ import annotations

import fcntl
import hashlib
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cohort import computing as own
from stimrig.api.cohort import record
from stimrig.api.cohort.computing import Bounds, Computing, run_parcel, run_record
from stimrig.api.cohort.sources import Entry
from stimrig.api.cohort.tasks import Task
from stimrig.api.version import software_version
from tests.harness import few_effects
from tests.harness.cohort_records import Session, write

pytestmark = pytest.mark.slow

MEMORY = 10**9
PATIENCE_S = 300.0
FIT = Task("fit")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write(tmp_path_factory.mktemp("good") / "good.h5", Session(muscle=2, seed=5)).read_bytes()


@pytest.fixture(scope="module")
def computing() -> Iterator[Computing]:
    with pytest.MonkeyPatch.context() as patch, closing(Computing(MEMORY)) as one:
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret-of-the-bucket")
        yield one


def entry(name: str = "good.h5", **known: Any) -> Entry:
    return Entry(f"/data/{name}", name, f"/data/{name}", known={"name": name, **known})


def row(
    computing: Computing, content: bytes, task: Task = FIT, limit_s: float = PATIENCE_S, **more: Any
) -> dict[str, Any]:
    return computing.compute(content, entry(**more), task, limit_s)["row"]


def pid(computing: Computing) -> int:
    assert computing.process is not None
    return computing.process.pid


def test_a_fit_gives_what_the_verb_gives(computing: Computing, good: bytes, tmp_path: Path) -> None:
    from stimrig import identify

    found = row(computing, good)
    (tmp_path / "good.h5").write_bytes(good)
    model = identify.fit(identify.read(tmp_path / "good.h5")).to_dict()
    assert (found["status"], found["participant"], found["day"]) == ("ok", "P001", "2026-01-05")
    assert found["record_id"] == "R-P001-5" and found["kind"] == "pre-session"
    assert found["fit_percent"] == pytest.approx(model["fit"]["fit_percent"])
    assert found["verdict"] == model["quality"]["verdict"]
    values = {entry["name"]: entry for entry in found["parameters"]}
    assert values["time_constant_s"]["value"] == pytest.approx(model["linear"]["time_constant_s"])
    assert values["threshold_us"]["unit"] == "µs" and values["threshold_us"]["sd"] > 0
    assert found["duration_s"] == pytest.approx(22.69) and found["rate_hz"] == pytest.approx(100)


def test_diagnosis_and_improvement_name_what_is_missing(tmp_path: Path) -> None:
    tired = write(tmp_path / "t.h5", Session(muscle=1, effect="fatigue"))
    with few_effects.only("fatigue", "output_saturation"):
        found, improved = (
            record.compute(lambda *_: None, str(tired), tired.name, {}, asdict(Task(verb)))["row"]
            for verb in ("diagnose", "improve")
        )
    assert found["verdict"] in ("effect_missing", "nothing_missing", "unexplained_structure")
    assert 0 <= found["probability"] <= 1 and found["fit_percent"] < found["ceiling_percent"] + 1
    assert all({"of", "name", "value", "sd", "unit"} == set(entry) for entry in found["parameters"])
    assert {entry["of"] for entry in found["parameters"]} <= {entry["effect"] for entry in found["effects"]}
    assert improved["verdict"] == found["verdict"]
    assert improved["steps"][0]["added"] is None
    assert len(improved["steps"]) == 1 + len(improved["effects"])


def test_a_selection_is_judged_once_the_record_is_read(computing: Computing, good: bytes) -> None:
    def left_out(select: str, content: bytes = good) -> bool:
        return "left_out" in computing.compute(content, entry(), Task("fit", select), PATIENCE_S)

    assert left_out('participant == "P002"') and left_out("duration_s > 100") and left_out('kind != "pre-session"')
    assert not left_out('participant == "P001" and day == "2026-01-05"')
    # Nobody knows whose the broken one is: it is told, not dropped.
    assert not left_out('participant == "P002"', good[:5000])


def test_a_record_that_hangs_is_ended_and_the_next_is_computed(computing: Computing, good: bytes) -> None:
    row(computing, good)
    first = pid(computing)
    found = row(computing, good, Task("diagnose"), limit_s=0.01)
    assert (found["status"], found["error_kind"]) == ("error", "timeout") and "--limit" in found["error"]
    assert row(computing, good)["status"] == "ok"
    assert pid(computing) != first
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)


def test_a_process_that_is_killed_is_a_row(computing: Computing, good: bytes) -> None:
    row(computing, good)
    assert computing.process is not None
    os.kill(pid(computing), signal.SIGSTOP)  # it takes the record, and computes for ever
    killer = threading.Timer(0.5, os.kill, (pid(computing), signal.SIGKILL))
    killer.start()
    found = row(computing, good)
    killer.join()
    assert found["error_kind"] == "killed" and "\n" not in found["error"]
    assert row(computing, good)["status"] == "ok"


def test_a_record_beyond_the_memory_is_a_row(good: bytes) -> None:
    table = b"time_s,pulse_width_us,torque_nm,segment\n"
    table += b"".join(b"%.4f,%d,%.3f,prbs\n" % (k / 400, 100 * (k // 200 % 2), k % 7) for k in range(400_000))
    with closing(Computing(24 * 2**20)) as small:
        found = row(small, table, name="large.csv")
    assert found["error_kind"] in ("out of memory", "killed") and "\n" not in found["error"], found


def test_a_process_is_renewed_after_some_records(good: bytes) -> None:
    pids = []
    with closing(Computing(MEMORY, records=2)) as computing:
        for _ in range(3):
            assert row(computing, good)["status"] == "ok"
            pids.append(pid(computing))
    assert pids[0] == pids[1] != pids[2]


@pytest.mark.parametrize("name", ["x.csv", "my-record.csv", "old/record.csv"])
def test_a_mistake_names_the_record_as_the_person_does(computing: Computing, name: str) -> None:
    found = row(computing, b"no table", name=name)
    assert found["error"].startswith(f"{name}, line 1: ")


def test_no_file_of_the_machine_can_be_read(computing: Computing, good: bytes, tmp_path: Path) -> None:
    """The child is shut in before it reads: what the harness of hostile files tries, tried directly."""
    row(computing, good)
    status = Path(f"/proc/{pid(computing)}/status").read_text()
    assert "NoNewPrivs:\t1" in status
    assert "Seccomp:\t2" in status


def test_the_environment_of_a_child_holds_no_key(computing: Computing, good: bytes) -> None:
    row(computing, good)
    assert os.environ["AWS_SECRET_ACCESS_KEY"] == "secret-of-the-bucket"
    assert b"secret-of" not in Path(f"/proc/{pid(computing)}/environ").read_bytes()


def test_what_a_killed_worker_left_is_taken_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    living = Computing(MEMORY)
    left = tmp_path / "stimrig-cohort-left"
    left.mkdir()
    (left / "lock").touch()
    (left / "record.h5").write_bytes(b"somebody's")
    other = Computing(MEMORY)
    assert not left.exists()
    assert len(list(tmp_path.iterdir())) == 2
    living.close()
    other.close()
    assert list(tmp_path.iterdir()) == []


def test_no_other_worker_takes_away_a_folder_that_is_being_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    take_lock = fcntl.flock

    def tidied_before(file: Any, how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", take_lock)
        own.tidy()  # another worker starts just then
        take_lock(file, how)

    monkeypatch.setattr(fcntl, "flock", tidied_before)
    worker = Computing(MEMORY)
    assert [file.name for place in tmp_path.iterdir() for file in place.iterdir()] == [own.LOCK]
    worker.close()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes of the process one that gives these answers on each call, CALL in them its number and N how many."""

    def take(*answers: str) -> None:
        script = tmp_path / "evil.py"
        script.write_text(
            'import json, sys\nprint(\'{"ready": true, "left_open": {}}\', flush=True)\n'
            f"for number, line in enumerate(sys.stdin):\n    said = {chr(10).join(answers)!r}\n"
            "    said = said.replace('CALL', json.loads(line)['call']).replace('NUMBER', str(number))\n"
            "    print(said, flush=True)\n"
        )
        monkeypatch.setattr(own, "CHILD", (sys.executable, str(script)))

    return take


def told(row: str) -> str:
    return f'{{"call": "CALL", "result": {{"row": {row}}}}}'


@pytest.mark.parametrize(
    "said",
    [
        "no JSON", "{}", "[1]", told("3"), told('{"status": "copy"}'), "[" * 100_000, "x" * 17_000_000, "\\xff",
        told('{"status": "ok", "notes": ' + "[" * 700 + "]" * 700 + "}"),
    ],
    ids=lambda said: said[:20],
)  # fmt: skip
def test_a_process_that_was_taken_over_cannot_end_a_run(taken_over: Callable[..., None], said: str) -> None:
    taken_over(said)
    with closing(Computing(MEMORY)) as computing:
        found = row(computing, b"")
    assert (found["status"], found["error_kind"]) == ("error", "unexpected")


@pytest.mark.parametrize("more", [told('{"status": "ok", "participant": "PNUMBER"}'), "no JSON", '{"call": '])
def test_what_was_said_behind_an_answer_is_nobody_elses(taken_over: Callable[..., None], more: str) -> None:
    taken_over(told('{"status": "ok", "participant": "PNUMBER"}'), more)
    with closing(Computing(MEMORY)) as computing:
        found = [row(computing, b"")["participant"] for _ in range(3)]
        assert found == ["P0"] * 3, "a fresh process each time, for the one before said what nobody asked"


def test_an_answer_on_another_record_is_passed_over(taken_over: Callable[..., None]) -> None:
    taken_over(told('{"status": "ok", "participant": "other"}').replace("CALL", "1"), told('{"status": "ok"}'))
    with closing(Computing(MEMORY)) as computing:
        assert "participant" not in row(computing, b"")


def test_a_process_has_no_say_in_which_record_it_was(taken_over: Callable[..., None]) -> None:
    taken_over(told('{"status": "ok", "sha256": "x", "address": "x", "other_version": "9", "software": "9"}'))
    try:
        found = of_worker(b"abc", Entry("address", "a", "a"))
        assert found["address"] == "address" and found["software"] == software_version()
        assert found["sha256"] == hashlib.sha256(b"abc").hexdigest()
    finally:
        own.close_all()


class Given:
    """A source of one content."""

    def __init__(self, content: bytes) -> None:
        self.content = content

    def open(self, _entry: Entry, most_bytes: int) -> bytes:
        return self.content[: most_bytes + 1]


def of_worker(content: bytes, one: Entry) -> dict[str, Any]:
    task = Task("fit", software=software_version())
    return run_record(Given(content), one, task, Bounds(PATIENCE_S, MEMORY, 10))  # pyright: ignore[reportArgumentType]


def test_a_file_that_is_too_large_is_a_row_without_a_look_inside(good: bytes) -> None:
    found = of_worker(good, Entry("a", "a", "a", bytes=10**12))
    assert found["error_kind"] == "bad record" and "256 MB" in found["error"]


def test_a_parcel_ends_in_time_with_what_is_done() -> None:
    """The first record is done in any case: nothing is sent round for ever."""
    records: Any = [(Given(b"no record"), Entry(name, name, name), ()) for name in "abc"]
    task = Task("fit", software=software_version())
    for patience_s, names in ((60.0, ["a", "b", "c"]), (0.0, ["a"])):
        found = run_parcel(records, task, Bounds(PATIENCE_S, MEMORY, 10), patience_s)
        assert [row["address"] for row in found.rows] == names and found.took_s > 0

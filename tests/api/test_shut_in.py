"""Workers hold no secret, are shut in, and their death is one clear line; what they leave behind is cleared away."""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import platform
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from stimrig.api.errors import ApiError
from stimrig.api.record_files import find_recording
from stimrig.api.workers import confinement
from stimrig.api.workers.pool import WORKER, Pool
from stimrig.api.workers.process import Places
from tests.api.conftest import REAL, STUB, Service, run_service, serving, soon
from tests.api.test_problems import problem
from tests.api.test_worker import with_pool
from tests.harness import hostile_shapes

pytestmark = pytest.mark.slow

SECRET = "the-administrators-token"
ROOT = Path(__file__).parents[2]


def kernel_shuts() -> set[str]:
    """What this system can shut, asked of the kernel itself."""
    landlock = ctypes.CDLL(None).syscall(confinement.CREATE_RULESET, None, 0, 1) >= 1
    filters = "\nSeccomp:" in Path("/proc/self/status").read_text() and platform.machine() in confinement.FORBIDDEN
    return {name for name, can in (("files", landlock), ("network", filters)) if can}


def shut_in(
    code: str, *folders: Path, writes: tuple[Path, ...] = (), root: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    """A process that shuts itself in, does what `code` says and tells `left` and what `code` put into `found`."""
    program = (
        "import json, os, sys\nfrom pathlib import Path\n"
        "from stimrig.api.workers.confinement import confine, limit_time\n"
        f"reads, writes = {[str(each) for each in folders]!r}, {[str(each) for each in writes]!r}\n"
        "left, found = confine(map(Path, reads), map(Path, writes)), {}\n"
        "def attempt(name, work):\n"
        "    try:\n        work()\n        found[name] = 'done'\n"
        "    except BaseException as error:\n        found[name] = type(error).__name__\n"
        f"{code}\nprint(json.dumps({{'left': left, 'found': found}}))"
    )
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(root)}
    command = [sys.executable, "-c", program]
    # not from the checkout's folder: that one is left out anyway
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=root.parent, timeout=120)


def attempt(code: str, *folders: Path, writes: tuple[Path, ...] = (), root: Path = ROOT) -> dict[str, Any]:
    """What a process that is shut in can still do."""
    done = shut_in(code, *folders, writes=writes, root=root)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_worker_has_no_secret_in_its_environment_and_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STIMRIG_ADMIN_TOKEN", "STIMRIG_DATABASE_URL", "SOME_PASSWORD"):
        monkeypatch.setenv(name, SECRET)

    async def work(pool: Pool) -> tuple[str, str]:
        await pool.submit("effects").result
        process = pool.workers[0].process
        assert process is not None
        folder = Path(f"/proc/{process.pid}")
        return (folder / "environ").read_bytes().decode(), (folder / "limits").read_text()

    environment, limits = with_pool(work, command=WORKER)
    assert SECRET not in environment and "STIMRIG_ADMIN" not in environment
    bounds = {line[:26].strip(): line[26:].split()[0] for line in limits.splitlines()}
    assert int(bounds["Max address space"]) == confinement.MEMORY_BYTES
    assert int(bounds["Max open files"]) == confinement.OPEN_FILES and bounds["Max core file size"] == "0"
    assert int(bounds["Max file size"]) == confinement.FILE_BYTES and bounds["Max cpu time"] != "unlimited"


def test_a_process_that_is_shut_in_reaches_no_network_no_program_and_no_other_file(tmp_path: Path) -> None:
    ours, theirs, out = (tmp_path / name for name in ("ours", "theirs", "out"))
    for folder in (ours, theirs, out):
        folder.mkdir()
        (folder / "file").write_text("x")
    code = f"""
import ctypes, resource, socket, subprocess
system = ctypes.CDLL(None, use_errno=True)
def call(*arguments):
    if system.syscall(*arguments) < 0:
        raise OSError(ctypes.get_errno(), 'refused')
attempt('ours', lambda: open({str(ours / "file")!r}).read())
attempt('theirs', lambda: open({str(theirs / "file")!r}).read())
attempt('parent', lambda: open(f'/proc/{{os.getppid()}}/environ', 'rb').read())
attempt('write there', lambda: open({str(out / "new")!r}, 'w').write('x'))
attempt('write ours', lambda: open({str(ours / "new")!r}, 'w').write('x'))
attempt('network', lambda: socket.socket())
attempt('local', lambda: socket.socket(socket.AF_UNIX))
attempt('rights', lambda: os.chmod({str(theirs)!r}, 0o777))
attempt('set rights', lambda: call(463, -100, {os.fsencode(theirs)!r}, 0, b'system.posix_acl_access', None, 0))
attempt('drop rights', lambda: call(466, -100, {os.fsencode(theirs)!r}, 0, b'system.posix_acl_access'))
attempt('owner', lambda: os.chown({str(theirs)!r}, os.getuid(), os.getgid()))
attempt('bounds', lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CORE))
attempt('own bounds', lambda: limit_time(100))
attempt('turn', lambda: os.sched_setscheduler(os.getppid(), os.SCHED_OTHER, os.sched_param(0)))
attempt('cores', lambda: os.sched_setaffinity(os.getppid(), os.sched_getaffinity(os.getppid())))
attempt('nice', lambda: os.setpriority(os.PRIO_PROCESS, os.getppid(), os.getpriority(os.PRIO_PROCESS, os.getppid())))
attempt('program', lambda: subprocess.run(['true']))
attempt('memory', lambda: bytearray({confinement.MEMORY_BYTES}))
"""
    seen = attempt(code, ours, writes=(out,))
    found, left = seen["found"], seen["left"]
    assert found["ours"] == found["write there"] == "done" and found["memory"] == "MemoryError"
    assert set(left) == {"files", "network"} - kernel_shuts(), left
    if "network" not in left:
        closed = (
            "network", "local", "rights", "set rights", "drop rights", "owner", "bounds", "turn", "cores", "nice",
        )  # fmt: skip
        assert {name: found[name] for name in closed} == dict.fromkeys(closed, "PermissionError")
    assert found["own bounds"] == "done"
    if "files" not in left:
        closed = ("theirs", "parent", "write ours", "program")
        assert {name: found[name] for name in closed} == dict.fromkeys(closed, "PermissionError")


@pytest.mark.skipif("files" not in kernel_shuts(), reason="no Landlock here")
def test_a_checkout_behind_a_link_is_not_open_as_a_whole(tmp_path: Path) -> None:
    """A data folder lies in it: by default `var`."""
    link = tmp_path / "link"
    link.symlink_to(ROOT)
    code = f"attempt('theirs', lambda: open({str(ROOT / 'README.md')!r}).read())\nimport stimrig.identify.fitting"
    assert attempt(code, root=link)["found"] == {"theirs": "PermissionError"}


def test_what_cannot_be_shut_is_said() -> None:
    program = (
        "import json, stimrig.api.workers.confinement as c\n"
        "c.LIBC = None\nc.FORBIDDEN = {}\nprint(json.dumps(c.confine()))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert set(json.loads(done.stdout)) == {"files", "network"}, done.stderr


def test_a_job_without_an_end_is_ended_by_its_processor_time() -> None:
    code = "limit_time(0.0)\nwhile True: pass"
    assert shut_in(code).returncode == -signal.SIGXCPU
    ends = (sys.executable, "-c", f"import os, sys; sys.stdin.readline(); os.kill(os.getpid(), {signal.SIGXCPU:d})")

    async def work(pool: Pool) -> None:
        with pytest.raises(ApiError, match="was ended after 300 s") as caught:
            await pool.submit("fit", data="x").result
        assert caught.value.status == 422

    with_pool(work, command=ends)


def test_a_recording_in_a_folder_not_known_yet_is_read_by_a_fresh_worker(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
        (folder / "good.h5").write_bytes(hostile_shapes.good())

    async def run() -> list[int]:
        pool, pids = Pool(1, places=Places([first])), []
        try:
            for folder in (first, second, first):
                await pool.submit("recorded", data=str(folder / "good.h5")).result
                process = pool.workers[0].process
                assert process is not None
                pids.append(process.pid)
        finally:
            await pool.close()
        return pids

    pids = asyncio.run(run())
    assert pids[0] != pids[1] == pids[2]


def test_hostile_files_through_a_worker(tmp_path: Path) -> None:
    """A few of each kind that libhdf5 or the memory could die of: refused in one line, or read as sound."""
    beside, uploads, rng = tmp_path / "service", tmp_path / "uploads", random.Random(3)
    beside.mkdir()
    uploads.mkdir()
    picked = ("gzip bomb", "virtual over raw storage", "external storage /proc/self/environ")
    files = [
        *hostile_shapes.hdf5_shapes(beside, only=picked),
        *(one for one in hostile_shapes.csv_shapes() if one.name == "a million columns"),
        hostile_shapes.Hostile("sound", ".h5", hostile_shapes.good(), refused=False),
        *(hostile_shapes.spoiled(rng, number) for number in range(6)),
    ]

    async def work() -> list[str]:
        pool, refused = Pool(1, places=Places([uploads])), []
        try:
            for hostile in files:
                path = uploads / f"upload{hostile.suffix}"
                path.write_bytes(hostile.content)
                try:
                    found = json.dumps(await pool.submit("fit", data=str(path)).result)
                    assert not hostile.refused, f"{hostile.name} was taken as sound"
                except ApiError as error:
                    found = error.detail
                    assert (error.status, error.code != "worker-died") == (422, True), (hostile.name, found)
                    assert "\n" not in found and len(found) < 400, (hostile.name, found)
                    refused.append(hostile.name)
                assert hostile_shapes.SECRET[:20].decode() not in found, hostile.name
        finally:
            await pool.close()
        return refused

    assert 4 <= len(asyncio.run(work())) < len(files)


@pytest.fixture
def deadly(tmp_path: Path, short_dir: Path) -> Iterator[Service]:
    """A service whose workers crash at every job, as libhdf5 might."""
    crash = "import os, sys; sys.stdin.readline(); os.kill(os.getpid(), 11)"
    yield from run_service(tmp_path, short_dir, (sys.executable, "-c", crash))


def test_an_upload_that_a_worker_dies_of_is_refused_in_one_line(deadly: Service) -> None:
    with deadly.client() as client:
        client.post("/v1/participants", json={"code": "P017"})
        found = problem(client.post("/v1/participants/P017/recordings", content=b"x"), 422)
    assert found["title"] == "The upload cannot be read" and "SIGSEGV" in found["detail"]
    assert str(deadly.data) not in found["detail"]
    assert not list((deadly.data / "recordings").rglob("upload-*"))


def test_no_path_of_this_machine_is_told_of_an_upload(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, REAL, workers=1):
        with service.client() as client:
            client.post("/v1/participants", json={"code": "P017"})
            content = hostile_shapes.good(hostile_shapes.virtual_over_raw, tmp_path)
            for body in (content, b"time_s,pulse_width_us,torque_nm,segment\n1,2,x,y\n"):
                answer = client.post("/v1/participants/P017/recordings", content=body)
                problem(answer, 422)
                assert str(tmp_path) not in answer.text and "the upload" in answer.text
        assert not list((service.data / "recordings").rglob("upload-*"))


def test_a_start_with_another_database_deletes_no_upload(
    tmp_path: Path, short_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A mistyped STIMRIG_DATABASE_URL, or an older database put back, names none of the files that are there."""
    kept = ""
    with serving(tmp_path, short_dir, STUB) as (_, client):
        client.post("/v1/participants", json={"code": "P017"})
        kept = client.post("/v1/participants/P017/recordings", content=b"a,b\n").json()["recording_id"]
    folder = tmp_path / "recordings"
    names = {f"{kept}.csv", "upload-00ff.h5", "joined-00ff.csv", "20260101T000000Z_T-1.h5", "upload-notes.txt"}
    for name in names - {f"{kept}.csv"}:
        (folder / name).write_bytes(b"x")
    for _ in run_service(tmp_path, short_dir, STUB, database_url=f"sqlite:///{tmp_path}/fresh.db"):
        assert f"{kept}.csv" in caplog.text and "Is it the right database?" in caplog.text
    with serving(tmp_path, short_dir, STUB) as (_, client):
        assert client.get(f"/v1/recordings/{kept}").text == "a,b\n"
    assert {path.name for path in folder.iterdir() if path.is_file()} == names


def test_what_an_ended_service_had_begun_to_take_in_is_settled_at_the_start(tmp_path: Path, short_dir: Path) -> None:
    kept = ""
    with serving(tmp_path, short_dir, STUB) as (_, client):
        client.post("/v1/participants", json={"code": "P017"})
        kept = client.post("/v1/participants/P017/recordings", content=b"a,b\n").json()["recording_id"]
    folder, parts = tmp_path / "recordings", tmp_path / "recordings" / "parts"
    (folder / f"{kept}.csv").replace(parts / f"{kept}.csv")  # it ended right after it had written the row
    for name in ("upload-00ff.csv", "upload-00ff.h5", "joined-00ff.csv"):
        (parts / name).write_bytes(b"x")
    with serving(tmp_path, short_dir, STUB) as (_, client):
        assert client.get(f"/v1/recordings/{kept}").text == "a,b\n"
    assert not list(parts.iterdir())


def test_a_row_that_is_not_written_leaves_no_file(tmp_path: Path, short_dir: Path, monkeypatch: pytest.MonkeyPatch):
    for service in run_service(tmp_path, short_dir, STUB):
        with service.client() as client:
            client.post("/v1/participants", json={"code": "P017"})
            monkeypatch.setattr("stimrig.api.web.routes.recordings.audit.write", Mock(side_effect=OSError("disk full")))
            assert client.post("/v1/participants/P017/recordings", content=b"a,b\n").status_code == 500
            monkeypatch.undo()
        assert not list((tmp_path / "recordings").rglob("upload-*"))


def test_an_upload_is_never_taken_for_the_recording_of_a_lost_test(tmp_path: Path) -> None:
    def named(name: str) -> dict[str, Any] | None:
        (tmp_path / name).write_bytes(hostile_shapes.good())
        return find_recording(lambda *_: None, str(tmp_path), "T-1")["found"]

    assert named("upload-00ff.h5") is None
    found = named("20260101T000000Z_T-1.h5")
    assert found is not None and found["recording_id"] == "R-1"


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b'{"code": "P1\xff"}', "not UTF-8"),
        (b'{"participant": "P1", "segments": [{"name": "a", "sequence": "rest", "settings": {"a": %s1%s}}]}'
         % (b'{"a":' * 900, b"}" * 900), "more than 16 brackets"),
        (b'{"code": "P1", "profile": {"current_ma": 10, "current_ma": 90}}', "'current_ma' is there twice"),
        (b'{"code": ' + b"1" * 5000 + b"}", "a number with too many digits"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["/v1/participants", "/v1/tests", "/v1/preview", "/v1/sessions"])
def test_json_that_is_not_sound_is_refused(shared_client: httpx.Client, path: str, body: bytes, says: str) -> None:
    silent: Any = None  # it does not look first at what it decides on
    answer = shared_client.post(path, content=body, headers={"content-type": "application/json"}, auth=silent)
    assert says in problem(answer, 400)["detail"]
    documented = shared_client.get("/openapi.json").json()["paths"][path]["post"]["responses"]
    assert {"400", "413"} <= set(documented)


def test_a_stop_is_a_stop_whatever_its_body(shared_client: httpx.Client) -> None:
    for body in (b"\xff\xff", b"[" * 900, b'{"reason": "a", "reason": "b"}'):
        answer = shared_client.post("/v1/stop", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 200, answer.text


def test_every_operation_with_a_body_documents_what_it_answers(shared_client: httpx.Client) -> None:
    operations = [
        (path, method, operation)
        for path, methods in shared_client.get("/openapi.json").json()["paths"].items()
        for method, operation in methods.items()
        if "requestBody" in operation
    ]
    assert len(operations) >= 14
    assert [(path, method) for path, method, operation in operations if "400" not in operation["responses"]] == []


def test_a_worker_is_killed_with_the_service_in_the_middle_of_a_call(tmp_path: Path) -> None:
    """It would not read that its input has ended before the call is done."""
    call = json.dumps({"call": 1, "verb": "warm", "arguments": {}})
    service = f"""
import subprocess, sys, time
worker = subprocess.Popen({list(WORKER)!r}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
worker.stdout.readline()
worker.stdin.write({call!r} + "\\n")
worker.stdin.flush()
worker.stdout.readline()
print(worker.pid, flush=True)
time.sleep(3600)
"""
    parent = subprocess.Popen([sys.executable, "-c", service], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    os.kill(worker, signal.SIGSTOP)  # it neither computes nor reads: only the kernel can end it
    parent.kill()
    parent.communicate()
    soon(lambda: not Path(f"/proc/{worker}").exists() or " Z " in Path(f"/proc/{worker}/stat").read_text(), 20)

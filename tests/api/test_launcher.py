"""The whole house as processes: emulator, rig, service."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cli.errors import LaunchError
from stimrig.api.cli.supervisor import Child, Services
from stimrig.api.client.errors import Conflict, Unavailable
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings
from tests.api.conftest import TOKEN, soon
from tests.api.test_logs import check_log_lines

pytestmark = pytest.mark.wire


def settings(tmp_path: Path, **more: object) -> Settings:
    return Settings(data_dir=tmp_path, port=0, **more)


@pytest.fixture(autouse=True)
def one_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each loads and compiles for seconds before it is needed."""
    monkeypatch.setenv("STIMRIG_WORKERS", "1")


@contextmanager
def running(tmp_path: Path) -> Iterator[tuple[Services, Client]]:
    with Services(settings(tmp_path), [], TOKEN) as services, Client(services.url, TOKEN) as client:
        yield services, client


def begin(client: Client) -> str:
    """Begin a test and wait until it has played for more than a second.

    A start is rightly refused where the machine stalled so long that a device seemed silent.
    """
    code = client.ensure_participant("P1").code

    def started() -> str | None:
        try:
            return client.start_test(code).id
        except Unavailable as error:
            assert "does not answer" in str(error)
            return None

    test_id = soon(started)
    soon(lambda: client.rig().elapsed_s > 1.0)
    return test_id


def ended(client: Client, test_id: str) -> Any:
    *_, last = client.follow(test_id)
    return last


@pytest.mark.timeout(900)  # an identification gives way to every other process: beside them it takes minutes
def test_a_test_on_the_wire_ends_in_a_served_model(tmp_path: Path) -> None:
    with running(tmp_path) as (services, client):
        assert client.http.get("/rig/now").json()["emulated"] is True
        test = client.run_test(client.make_participant("P-SECRET-7").code, protocol="short")
        assert test.summary.lost_samples == 0 and test.fit is not None
        assert (test.fit.ceiling_percent or 0) > 95 and (test.fit.fit_percent or 0) > 90
        assert {part.name for part in client.curves(test.fit.id).segments} >= {"rest", "prbs", "ramp", "validate"}
        assert client.preview("P-SECRET-7").torque_time_nms is None
        # Where the machine stalled, the model may be poor: then an approval needs a reason.
        client.approve(test.fit.id, "Nobody is stimulated: this test looks at the launcher only.")
        assert (client.preview("P-SECRET-7").torque_time_nms or 0) > 5
    assert [child.alive() for child in (services.rig, services.api)] == [False, False]
    check_log_lines(tmp_path / "logs", test.id, (TOKEN, "P-SECRET-7", "Nobody is stimulated"))


def test_only_the_emulator_makes_an_emulated_rig(tmp_path: Path) -> None:
    """A rig file names devices of the world, whatever was left in the environment."""
    for more, said in (({}, "true"), ({"rig_file": tmp_path / "rig.toml", "emulated": True}, "false")):
        assert Services(settings(tmp_path, **more)).api.environment["STIMRIG_EMULATED"] == said


def test_ending_the_service_in_a_test_stops_it_and_keeps_its_record(tmp_path: Path) -> None:
    """A killed rig comes back uncertain, and its test is a fault; the next test is under way when all is ended."""
    with running(tmp_path) as (services, client):
        test_id = begin(client)
        services.rig.process.kill()
        soon(lambda: not client.rig().connected)
        assert any("rig had ended" in event for event in services.watch())
        test = ended(client, test_id)
        assert test.state == "fault"
        assert test.recording_id, "the journal of the killed rig was sealed and adopted"
        assert client.rig().state == "uncertain"
        with pytest.raises(Conflict):
            client.start_test("P1")
        assert client.post("/v1/rearm")["state"] == "ready"
        test_id = begin(client)
    with running(tmp_path) as (_, client):
        test = client.test(test_id)
        assert test.state == "stopped" and "shutting down" in test.reason
        assert client.recording(test.recording_id).startswith(b"\x89HDF")


RIG_FILE = """
stimulator = {{ device = "{device}", port = "/dev/ttyUSB77" }}
[load_cell]
device = "can_load_cell"
signal = "Torque_Nm"
bus = {{ interface = "socketcand", host = "127.0.0.1", port = 1, channel = "can0" }}
"""


@pytest.mark.parametrize(
    ("device", "verb", "named"),
    [("p99", "serve", ("rig.toml", "p99")), ("p24", "test", ("/dev/ttyUSB77",))],
    ids=["unknown-device", "no-such-port"],
)
def test_rig_file_that_does_not_hold_is_one_line(
    tmp_path: Path, device: str, verb: str, named: tuple[str, ...]
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG_FILE.format(device=device))
    command = [sys.executable, "-m", "stimrig", verb, "--rig", str(path), "--data", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2, done
    assert done.stderr.count("\n") == 1 and "Traceback" not in done.stderr
    assert all(word in done.stderr for word in named)


def test_taken_port_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = Child.start
    monkeypatch.setattr(Child, "start", lambda child: start(child) if child.name == "api" else child.ready)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        second = settings(tmp_path)
        second.port = taken.getsockname()[1]
        with pytest.raises(LaunchError, match="another port") as caught, Services(second, [], TOKEN):
            pass
    assert caught.value.exit_code == 2

"""The whole house as processes: emulator, rig, service."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from stimrig.api.cli.errors import LaunchError
from stimrig.api.cli.supervisor import Services
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings
from tests.api.conftest import TOKEN, soon, wait_done
from tests.api.test_logs import check_log_lines
from tests.harness.looks_first import LooksFirst

pytestmark = pytest.mark.wire


def settings(tmp_path: Path, **more: object) -> Settings:
    return Settings(data_dir=tmp_path, port=0, **more)  # pyright: ignore[reportArgumentType]


def client(services: Services) -> httpx.Client:
    return httpx.Client(base_url=services.url, auth=LooksFirst(TOKEN), timeout=60)


def playing(http: httpx.Client) -> bool:
    """Whether the test has played for more than a second."""
    return http.get("/v1/rig").json()["elapsed_s"] > 1.0


@pytest.mark.timeout(900)  # an identification gives way to every other process: beside them it takes minutes
def test_a_test_on_the_wire_ends_in_a_served_model(tmp_path: Path) -> None:
    with Services(settings(tmp_path), [], TOKEN) as services, Client(services.url, TOKEN) as rest:
        http = rest.http
        assert http.get("/rig/now").json()["emulated"] is True
        document = rest.run_test(rest.make_participant("P-SECRET-7")["code"], protocol="short")
        assert document["summary"]["lost_samples"] == 0
        fit = document["fit"]
        assert fit["ceiling_percent"] > 95 and fit["fit_percent"] > 90
        curves = http.get(f"{document['model_url']}/curves").json()
        assert {part["name"] for part in curves["segments"]} >= {"rest", "prbs", "ramp", "validate"}
        preview = http.post("/v1/preview", json={"participant": "P-SECRET-7"}).json()
        assert preview["torque_time_nms"] is None
        # Where the machine stalled, the model may be poor: then an approval needs a reason.
        reason = "Nobody is stimulated: this test looks at the launcher only."
        http.post(f"{document['model_url']}/approve", json={"reason": reason}).raise_for_status()
        assert http.post("/v1/preview", json={"participant": "P-SECRET-7"}).json()["torque_time_nms"] > 5
    assert [child.alive() for child in (services.rig, services.api)] == [False, False]
    check_log_lines(tmp_path / "logs", document["id"], (TOKEN, "P-SECRET-7", "Nobody is stimulated"))


def test_only_the_emulator_makes_an_emulated_rig(tmp_path: Path) -> None:
    """A rig file names devices of the world, whatever was left in the environment."""
    assert Services(settings(tmp_path)).emulated
    assert not Services(settings(tmp_path, rig_file=tmp_path / "rig.toml", emulated=True)).emulated
    attached = {emulated: settings(tmp_path, emulated=emulated) for emulated in (True, False)}
    assert [Services(s, attach=tmp_path / "s").emulated for s in attached.values()] == [True, False]


def test_killed_rig_comes_back_uncertain_and_the_test_is_a_fault(tmp_path: Path) -> None:
    with Services(settings(tmp_path), [], TOKEN) as services, client(services) as http:
        http.post("/v1/participants", json={"code": "P1"})
        test_id = http.post("/v1/tests", json={"participant": "P1"}).json()["id"]
        soon(lambda: playing(http))
        assert services.rig.process is not None
        services.rig.process.kill()
        services.rig.process.wait()
        soon(lambda: not http.get("/v1/rig").json()["connected"])
        assert any("rig had ended" in event for event in services.watch())
        document = wait_done(http, test_id, 60)
        assert document["state"] == "fault"
        assert document["recording_id"], "the journal of the killed rig was sealed and adopted"
        rig = http.get("/v1/rig").json()
        assert rig["state"] == "uncertain"
        assert http.post("/v1/tests", json={"participant": "P1"}).status_code == 409
        assert http.post("/v1/rearm").json()["state"] == "ready"


@pytest.mark.campaign
@pytest.mark.timeout(900)  # an identification gives way to every other process: beside them it takes minutes
def test_killed_service_comes_back_at_the_same_place_with_everything(tmp_path: Path) -> None:
    with Services(settings(tmp_path), [], TOKEN) as services, client(services) as http:
        http.post("/v1/participants", json={"code": "P1"})
        test_id = http.post("/v1/tests", json={"participant": "P1"}).json()["id"]
        soon(lambda: playing(http))
        assert services.api.process is not None
        services.api.process.kill()
        services.api.process.wait()
        assert any("api had ended" in event for event in services.watch())
        document = wait_done(http, test_id, 800)
        assert document["state"] == "completed", document["reason"]
        assert document["model_id"]


RIG_FILE = """
[stimulator]
device = "{device}"
port = "{port}"
[load_cell]
device = "can_load_cell"
signal = "Torque_Nm"
[load_cell.bus]
interface = "socketcand"
host = "127.0.0.1"
port = 1
channel = "can0"
"""


@pytest.mark.parametrize(
    ("device", "verbs", "named"),
    [("p99", ("serve", "test"), ("rig.toml", "p99")), ("p24", ("test",), ("/dev/ttyUSB77",))],
    ids=["unknown-device", "no-such-port"],
)
def test_rig_file_that_does_not_hold_is_one_line(
    tmp_path: Path, device: str, verbs: tuple[str, ...], named: tuple[str, ...]
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG_FILE.format(device=device, port="/dev/ttyUSB77"))
    for verb in verbs:
        command = [sys.executable, "-m", "stimrig", verb, "--rig", str(path), "--data", str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 2, done
        assert done.stderr.count("\n") == 1 and "Traceback" not in done.stderr
        assert all(word in done.stderr for word in named)


def test_taken_port_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        second = settings(tmp_path, rig_file=None)
        second.port = taken.getsockname()[1]
        with pytest.raises(LaunchError, match="another port") as caught, Services(second, [], TOKEN):
            pass
    assert caught.value.exit_code == 2


def test_ending_the_service_in_a_test_stops_it_and_keeps_its_record(tmp_path: Path) -> None:
    with Services(settings(tmp_path), [], TOKEN) as services, client(services) as http:
        http.post("/v1/participants", json={"code": "P1"})
        test_id = http.post("/v1/tests", json={"participant": "P1"}).json()["id"]
        soon(lambda: playing(http))
    with Services(settings(tmp_path), [], TOKEN) as services, client(services) as http:
        document = http.get(f"/v1/tests/{test_id}").json()
        assert document["state"] == "stopped" and "shutting down" in document["reason"]
        assert http.get(document["recording_url"]).content.startswith(b"\x89HDF")

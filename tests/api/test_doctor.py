"""`stimrig doctor` says what is wrong and how to fix it."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import Mock

import httpx
import pytest

from stimrig.api.cli import main
from stimrig.api.cli.commands import doctor
from stimrig.api.cli.commands.doctor import Finding, examine
from stimrig.api.settings import Settings
from tests.api.conftest import Service

pytestmark = pytest.mark.slow

RIG = """data_dir = "{folder}"
socket = "{folder}/rig.sock"
[stimulator]
device = "p24"
port = "{port}"
[load_cell]
device = "can_load_cell"
bus = {{ interface = "{interface}", channel = "{channel}" }}
"""


def rig_file(folder: Path, port: str = "/dev/null", interface: str = "slcan", channel: str = "/dev/null") -> Path:
    path = folder / "rig.toml"
    path.write_text(RIG.format(folder=folder, port=port, interface=interface, channel=channel))
    return path


def finding(name: str, **settings: object) -> Finding:
    return next(found for found in examine(Settings(**settings)) if found.check == name)


def test_sound_machine_exits_0_and_one_json_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["doctor", "--data", str(tmp_path), "--rig", str(rig_file(tmp_path)), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    verdicts = {found["check"]: found["verdict"] for found in report["findings"]}
    assert verdicts["rig file"] == verdicts["stimulator"] == verdicts["load cell"] == "ok"
    assert set(verdicts) >= {"data folder", "disk", "priority", "database"}


def test_missing_devices_exit_1_with_the_mend(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path, port=str(tmp_path / "not-there"), interface="socketcan", channel="can77")
    assert main.run(["doctor", "--data", str(tmp_path), "--rig", str(path)]) == 1
    out = capsys.readouterr().out
    assert "not-there is not there" in out and "plug it in" in out
    assert "there is no interface can77" in out and "stimrig-can@can77" in out


def test_wrong_key_of_the_rig_file_is_named(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    path.write_text(path.read_text().replace("port =", "prot ="))
    found = finding("rig file", rig_file=path, data_dir=tmp_path)
    assert found.verdict == "fails" and "stimulator.port" in found.says


def test_each_check_of_the_machine_finds_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Little room, a folder open to all, a check that breaks, no port."""
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: Mock(free=0.1e9))
    monkeypatch.setattr(doctor, "check_rights", Mock(side_effect=RuntimeError("no such thing")))
    for mode, fix in ((0o755, "chmod o-rwx"), (0o750, "")):
        tmp_path.chmod(mode)
        found = {one.check: one for one in examine(Settings(data_dir=tmp_path))}
        assert found["data folder"].fix.partition(" /")[0] == fix
    assert found["disk"].verdict == "fails" and "no such thing" in found["rights"].says
    assert doctor.examine_port("stimulator", Path(__file__)).verdict == "fails"


def test_rig_that_is_not_there_or_stands_still(service: Service, client: httpx.Client, tmp_path: Path) -> None:
    assert finding("rig", data_dir=tmp_path, rig_socket=tmp_path / "none.sock").verdict == "fails"
    assert finding("rig", data_dir=tmp_path, rig_socket=service.rig.path).verdict == "ok"
    client.post("/v1/stop")
    found = finding("rig", data_dir=tmp_path, rig_socket=service.rig.path)
    assert found.verdict == "fails" and "latched" in found.says and "re-arm" in found.fix


def test_tampered_trail_is_found(service: Service) -> None:
    assert finding("database", data_dir=service.data).verdict == "ok"
    service.sql("UPDATE audit SET who = 'nobody' WHERE seq = 1")
    assert finding("database", data_dir=service.data).verdict == "fails"

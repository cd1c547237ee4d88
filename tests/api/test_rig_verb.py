"""`stimrig rig`: words, exit codes, certificate; a check that is due is told by page, doctor and metrics."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.charts.certificate import certificate
from stimrig.api.cli import main
from stimrig.api.cli.commands.doctor import examine
from stimrig.api.settings import Settings
from stimrig.rig.messages import CheckStatus
from tests.api.conftest import Service, signed_in, soon
from tests.api.test_doctor import rig_file
from tests.api.test_schemas import unmet

REPORT: dict[str, Any] = {
    "format": "stimrig-rig-check",
    "format_version": 1,
    "verdict": "faults",
    "checked_at_utc": "2026-11-02T08:00:00.000Z",
    "due_at_utc": "2026-12-02T08:00:00.000Z",
    "by": "Jörg",
    "rig": "ab" * 32,
    "software": "stimrig 1.0",
    "emulated": True,
    "dummy_load_ohm": 1000.0,
    "rig_file": "rig.toml",
    "rig_file_sha256": "cd" * 32,
    "devices": {"stimulator": {"device": "p24", "serial_number": "S-17"}, "load_cell": {"serial_number": "C-4"}},
    "steps": [
        {
            "name": "stop",
            "title": "stop",
            "outcome": "failed",
            "figure": "−3 ms → late",
            "bound": "60 ms",
            "fault": "stop_late",
            "cause": "pulses flow",
            "mend": "change 1 kΩ",
        },
        {
            "name": "sync",
            "title": "sync line",
            "outcome": "passed",
            "figure": "80",
            "bound": "",
            "fault": "",
            "cause": "",
            "mend": "",
        },
    ],
}


def words(pdf: bytes) -> str:
    """What a PDF's pages say."""
    parts = [zlib.decompress(part) for part in re.findall(rb"stream\n(.*?)\nendstream", pdf, re.DOTALL)]
    shown = re.findall(rb"\(((?:[^()\\]|\\.)*)\)", b"".join(parts))
    return b" ".join(shown).decode("latin-1")


def test_the_certificate_says_what_was_checked() -> None:
    said = words(certificate(REPORT))
    for text in (
        "FAULTS",
        "emulated",
        "2026-11-02",
        "2026-12-02",
        "ab" * 32,
        "cd" * 16,
        "stimrig 1.0",
        "S-17",
        "C-4",
        "-3 ms",
        "60 ms",
        "change",
        "kOhm",
        "Jörg",
        "Signature",
    ):
        assert text in said, (text, said)
    sound = words(certificate({**REPORT, "verdict": "sound", "emulated": False}))
    assert "SOUND" in sound and "emulated" not in sound


@pytest.mark.slow
def test_check_tells_a_fault_with_its_mend(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file, pdf = str(rig_file(tmp_path, port=str(tmp_path / "nothing"))), tmp_path / "c.pdf"
    asked = ["rig", "check", "--rig", file, "--by", "Jo", "--no-questions", "-o", str(pdf)]
    assert main.run(asked) == 1
    out, err = capfd.readouterr()
    assert out.startswith("faults: checked ") and "udev" in out and "FAULT" in err
    assert "FAULTS" in words(pdf.read_bytes())
    assert main.run([*asked, "--json"]) == 1
    report = json.loads(capfd.readouterr().out)
    assert unmet("rig", report) == []
    assert report == json.loads((tmp_path / "check.json").read_text()) and report["rig_file"] == file


@pytest.mark.slow
def test_bad_input_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for asked in (
        ["check"],
        ["check", "--rig", "a", "--emulator-json", "b"],
        ["check", "--rig", str(tmp_path / "no.toml")],
        ["check", "--emulator-json", "{}"],
        ["init", "-o", str(tmp_path / "no" / "rig.toml"), "--yes"],
    ):
        assert main.run(["rig", *asked]) == 2
        out, err = capfd.readouterr()
        assert out == "" and "Traceback" not in err
        assert len(err.strip().splitlines()) == 1 or "found, without opening any" in err


@pytest.mark.slow
def test_init_writes_a_file_that_the_rig_reads(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asked = [
        "rig",
        "init",
        "-o",
        str(tmp_path / "rig.toml"),
        "--yes",
        "--stimulator",
        "rehastim2",
        "--channels",
        "b=1,t=2",
    ]
    assert main.run(asked) == 0
    assert json.loads(capfd.readouterr().out)["devices"]["stimulator"] == "rehastim2"
    assert main.run(asked) == 2 and "it exists" in capfd.readouterr().err


# ---- told where it is due


DUE = CheckStatus(
    verdict="sound",
    checked_at_utc="2026-01-02T00:00:00.000Z",
    due_at_utc="2026-02-01T00:00:00.000Z",
    by="Jo",
    same_rig=True,
    due="the check of the rig is due again",
)


def test_a_check_that_is_due_is_told(service: Service, client: httpx.Client, tmp_path: Path) -> None:
    assert "check" not in client.get("/v1/rig").json() and "stimrig_rig_check_due 0.0" in client.get("/metrics").text
    service.rig.check = DUE
    service.rig.become("ready")
    told = soon(lambda: client.get("/v1/rig").json().get("check"))
    assert told["due"] == DUE.due
    assert "stimrig_rig_check_due 1.0" in client.get("/metrics").text
    with signed_in(service) as pages:
        for page in ("/", "/administration"):
            assert "The check of the rig is due again" in pages.get(page).text.replace("the check", "The check")
    found = {one.check: one for one in examine(Settings(data_dir=tmp_path, rig_socket=service.rig.path))}
    assert found["check"].verdict == "care" and "stimrig rig check" in found["check"].fix
    service.rig.check = DUE.model_copy(update={"due": ""})
    service.rig.become("ready")
    soon(lambda: "stimrig_rig_check_due 0.0" in client.get("/metrics").text)
    with signed_in(service) as pages:
        assert "found sound" in pages.get("/administration").text

"""One verdict on a model: identify's, the same wherever it is shown."""

from __future__ import annotations

import html
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stimrig.api.cli import main
from stimrig.api.models import stored_model
from stimrig.api.models.registry import Versions
from tests.api.conftest import REAL, run_service
from tests.harness.patients import Patient, make_record

GATE = {"passed": False, "severity": "refuse", "says": "the dynamics are unstable"}


def record_csv(path: Path, *, follows: bool, level: bool = False) -> Path:
    """A made-up record; the torque does not follow the pulses, or the held-out torque is level."""
    rng = np.random.default_rng(3)
    record, _ = make_record(Patient(), rng, rate_hz=100, noise_nm=0.05)
    torque = record.torque_nm if follows else rng.standard_normal(record.time_s.size)
    names = np.array(record.segment_names)[record.segment]
    if level:
        torque = np.where(names == "validate", 0.25, torque)
    rows = zip(record.time_s, record.pulse_width_us, torque, names, strict=True)
    lines = [f"{t:.4f},{u:.3f},{y:.6f},{name}" for t, u, y, name in rows]
    path.write_text("\n".join(["time_s,pulse_width_us,torque_nm,segment", *lines]))
    return path


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main.run([str(argument) for argument in arguments]) == 0
    return capsys.readouterr().out


@pytest.mark.slow
def test_not_usable_is_said_in_each_place(tmp_path: Path, short_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = record_csv(tmp_path / "noise.csv", follows=False)
    printed, report = said(capsys, "fit", data, "-o", tmp_path / "MODEL.json"), tmp_path / "report.html"
    stored = json.loads((tmp_path / "MODEL.json").read_text())["quality"]
    assert stored["verdict"] == "not usable" and stored["words"].startswith("Do not use this model: ")
    assert f"not usable: {stored['words']}" in printed
    assert json.loads(said(capsys, "fit", data, "--json"))["quality"] == stored
    assert stored["words"] in said(capsys, "compare", tmp_path / "MODEL.json", data, "--html", report)
    pages = {"report of the command line": report.read_text("utf-8")}
    for service in run_service(tmp_path / "service", short_dir, REAL):
        with service.client() as client:
            client.post("/v1/participants", json={"code": "P1"})
            sent = client.post("/v1/participants/P1/recordings", content=data.read_bytes(), timeout=200)
            assert sent.status_code == 201, sent.text
            found = sent.json()["model"]
            whole = client.get(f"/v1/models/{found['id']}").json()
            for answer in (found, whole, whole["model"]["quality"], *client.get("/v1/participants/P1/models").json()):
                assert {key: answer[key] for key in ("verdict", "words", "reasons")} == {
                    key: stored[key] for key in ("verdict", "words", "reasons")
                }
            for path in (f"/models/{found['id']}?diagnose=0", f"/models/{found['id']}/report"):
                pages[path] = client.get(path).text
            for path in ("/", "/participants/P1"):
                text = client.get(path).text
                assert '<span class="tag tag-not-usable">not usable</span>' in text, path
    for place, text in pages.items():
        assert "verdict-not-usable" in text and ">not usable" in text, place
        for words in (stored["words"], *stored["reasons"][1:]):
            assert words in html.unescape(text), (place, words)


@pytest.mark.slow
def test_level_held_out_torque_has_no_percent(
    tmp_path: Path, short_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = record_csv(tmp_path / "level.csv", follows=True, level=True)
    printed, report = said(capsys, "fit", data, "-o", tmp_path / "MODEL.json"), tmp_path / "report.html"
    assert f"held out       {stored_model.UNDEFINED}, rms" in printed
    fit = json.loads((tmp_path / "MODEL.json").read_text())["fit"]
    assert fit["held_out_fit_percent"] is None and fit["held_out_ceiling_percent"] is None
    assert fit["held_out_rms_nm"] > 0
    assert stored_model.UNDEFINED in said(capsys, "compare", tmp_path / "MODEL.json", data, "--html", report)
    assert stored_model.UNDEFINED in report.read_text("utf-8")
    for service in run_service(tmp_path / "service", short_dir, REAL):
        with service.client() as client:
            client.post("/v1/participants", json={"code": "P1"})
            sent = client.post("/v1/participants/P1/recordings", content=data.read_bytes(), timeout=200)
            assert sent.status_code == 201, sent.text
            found = sent.json()["model"]
            assert found["verdict"] == "not usable" and "whose torque is constant" in found["words"]
            assert found["held_out_fit_percent"] is None and found["held_out_rms_nm"] > 0
            assert client.get(f"/v1/models/{found['id']}/comparison").status_code == 200
            for path in (f"/models/{found['id']}?diagnose=0", f"/models/{found['id']}/report"):
                assert stored_model.UNDEFINED in client.get(path).text
            assert client.get("/participants/P1").status_code == client.get("/").status_code == 200


@pytest.mark.parametrize(
    ("stored", "verdict", "words"),
    [
        (None, "unknown", "No verdict was stored"),
        ({"verdict": "splendid"}, "unknown", "No verdict was stored"),
        ({"verdict": "usable", "gates": {"stable": {"passed": True}}}, "usable", "Nothing speaks against it."),
        ({"verdict": "usable", "words": "Fits well.", "gates": {"a": {"passed": True}}}, "usable", "Fits well."),
        ({"verdict": "usable with care", "reasons": ["it jumps"]}, "usable with care", "It jumps."),
        ({"verdict": "good"}, "usable", ""),
        ({"verdict": "usable"}, "usable with care", "Look at where it fails"),
        ({"verdict": "poor"}, "not usable", "Do not rely on it."),
        ({"verdict": "good", "words": "Fits well.", "gates": {"stable": GATE}}, "not usable", "Do not rely on it."),
    ],
)
def test_older_models_are_read(stored: dict[str, Any] | None, verdict: str, words: str) -> None:
    document = {"fit": {}} | ({} if stored is None else {"quality": stored})
    found = stored_model.quality(document)
    assert found["verdict"] == verdict and found["words"].startswith(words)
    row: Any = SimpleNamespace(fit={}, etag="1", document=json.dumps(document).encode())
    versions = Versions(None, None)  # pyright: ignore[reportArgumentType]
    assert versions.quality(row) == versions.quality(row) == found

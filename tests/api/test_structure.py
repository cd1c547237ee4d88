"""The structure that a site's new participants start with: taken by the fit after a test, kept, shown, refused."""

from __future__ import annotations

import html
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from stimrig.api.cli import main
from stimrig.api.settings import Settings
from tests.api.conftest import STUB, Service, run_service, run_test
from tests.api.test_access import csrf, signed_in
from tests.api.test_one_service import command

pytestmark = pytest.mark.slow


@pytest.fixture
def site(tmp_path: Path, short_dir: Path) -> Iterator[Service]:
    yield from run_service(tmp_path / "site", short_dir, STUB, structure="fatigue, tremor")


def test_settings_name_effects_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().structure == ()
    monkeypatch.setenv("STIMRIG_STRUCTURE", " fatigue,threshold_drift ,fatigue,")
    assert Settings().structure == ("fatigue", "threshold_drift")


def test_models_have_the_sites_structure_until_one_is_approved(site: Service) -> None:
    settings = site.app.state.context.settings
    with site.client() as client:
        client.post("/v1/participants", json={"code": "P1"})
        first = client.get(f"/v1/models/{run_test(client, 'P1')['model_id']}").json()
        assert (first["effects"], first["parent_id"]) == (["fatigue", "tremor"], None)
        own = client.get(f"/v1/models/{first['id']}/diagnosis").json()
        assert own["structure"] == ["fatigue", "tremor"]
        assert "fatigue" not in [entry["effect"] for entry in own["missing"]]
        rows = client.post(f"/v1/models/{first['id']}/improve").json()["versions"]
        assert [row["parent_id"] for row in rows] == [None, first["id"]]
        client.post(f"/v1/models/{first['id']}/approve")
        settings.structure = ("threshold_drift",)
        assert client.get(f"/v1/models/{run_test(client, 'P1')['model_id']}").json()["effects"] == ["fatigue", "tremor"]
        client.post("/v1/participants", json={"code": "P2"})
        assert run_test(client, "P2")["fit"]["effects"] == ["threshold_drift"]
        settings.structure = ("fatigue",)
        assert run_test(client, "P2")["fit"]["effects"] == ["fatigue"]
        client.post("/v1/participants", json={"code": "P3"})
        csv = "time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n"
        taken = client.post("/v1/participants/P3/recordings", content=csv).json()
        assert (taken["model"]["effects"], taken["warnings"]) == (["fatigue"], [])


def test_structure_that_the_recording_does_not_bear_is_left_out_and_said(site: Service) -> None:
    """A person went through the test: it gives a model all the same."""
    site.app.state.context.settings.structure = ("bad",)
    with site.client() as client:
        client.post("/v1/participants", json={"code": "P1"})
        test = run_test(client, "P1")
        assert test["state"] == "completed"
        assert client.get(f"/v1/models/{test['model_id']}").json()["effects"] == []
        assert "not with bad: no effect bad" in test["summary"]["warnings"][-1]
        with signed_in(site) as browser:
            assert csrf(browser) and "not with bad" in browser.get(f"/models/{test['model_id']}").text


def test_an_uploads_model_page_says_what_was_left_out_of_its_structure(site: Service) -> None:
    """The page, the REST answer and the report say the same, also when they are loaded again."""
    site.app.state.context.settings.structure = ("bad",)
    csv = "time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n"
    with site.client() as client, signed_in(site) as browser:
        for code in ("P1", "P2"):
            client.post("/v1/participants", json={"code": code})
        (told,) = client.post("/v1/participants/P1/recordings", content=csv).json()["warnings"]
        form, token = "/participants/P2/recordings", csrf(browser)
        page = browser.post(
            form, data={"csrf": token}, files={"file": ("a.csv", f"{csv}0.025,0,0,rest\n")}, follow_redirects=True
        )
        assert page.url.path.startswith("/models/") and html.escape(told) in page.text
        assert html.escape(told) in browser.get(page.url.path).text
        exports = page.text.partition('aria-label="Export"')[2].partition("</div>")[0]
        assert ">CSV<" in exports and ">HDF5<" not in exports, "it came as a table"
        assert html.escape(told) in browser.get(f"{page.url.path}/report").text


def test_administration_shows_it(site: Service, service: Service) -> None:
    for place, words in ((site, "<b>fatigue, tremor</b>"), (service, "<b>plain</b>")):
        with signed_in(place) as browser:
            assert words in browser.get("/administration").text


def test_unknown_effect_is_one_line_before_the_service_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = command(tmp_path, STRUCTURE="fatigue,phlogiston")
    done = subprocess.run(**given, capture_output=True, timeout=120)
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and done.stdout == ""
    assert line.startswith("stimrig: STIMRIG_STRUCTURE: no effect is called phlogiston. Take some of ")
    monkeypatch.setenv("STIMRIG_STRUCTURE", "Fatigue!")
    assert main.run(["serve", "--data", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "STIMRIG_STRUCTURE: Fatigue! is no effect's id" in err

"""The script that calls REST for every form: sent, refused at the field or at the top, asked, overtaken, unanswered."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.api.browser import UNCOVERED, expected
from tests.api.conftest import Service, shared_service
from tests.api.test_profiles import calibrate

pytestmark = pytest.mark.browser
service = shared_service()


def open_form(tab: Any, service: Service, code: str) -> Any:
    """Open the page of a new participant; return the form of side and muscle."""
    with service.client() as client:
        client.post("/v1/participants", json={"code": code})
        if code == "P017":
            client.put(f"/v1/participants/{code}/muscle", json={"side": "left"})
            calibrate(client)
    tab.goto(f"{service.url}/participants/{code}")
    return tab.locator("#about form").first


def save(form: Any) -> None:
    form.get_by_role("button", name="Save side and muscle").click()


def site(service: Service, code: str) -> tuple[Any, Any]:
    with service.client() as client:
        row = client.get(f"/v1/participants/{code}").json()
    return row["side"], row["muscle"]


def test_a_field_that_does_not_hold_says_so_beside_it(tab: Any, service: Service) -> None:
    form = open_form(tab, service, "A2")
    form.get_by_label("Side").select_option("left")
    field = form.get_by_label("Muscle")
    field.fill("biceps\u200e")
    save(form)
    expected(field).to_have_attribute("aria-invalid", "true")
    expected(field).to_be_focused()
    expected(tab.locator("#muscle-error")).to_contain_text("U+200E")
    expected(tab.get_by_role("alert").filter(has_text="See beside the field.")).to_be_visible()
    assert site(service, "A2") == (None, None) and field.input_value() == "biceps\u200e"
    field.fill("biceps")
    save(form)
    expected(tab.get_by_text("left, biceps").first).to_be_visible()
    assert site(service, "A2") == ("left", "biceps")


def test_what_deserves_a_second_look_is_asked_with_stop_in_reach(tab: Any, service: Service) -> None:
    form = open_form(tab, service, "P017")
    form.get_by_label("Side").select_option("right")
    save(form)
    question = tab.get_by_role("dialog", name="Change side and muscle of P017?")
    expected(question).to_contain_text("The calibration is lost with it")
    expected(question.get_by_role("row", name="Side and muscle left right")).to_be_visible()
    assert tab.evaluate(UNCOVERED) and site(service, "P017")[0] == "left"
    question.get_by_role("button", name="No, go back").click()
    expected(question).to_have_count(0)
    save(form)
    question.get_by_role("button", name="Yes, it is right").click()
    tab.get_by_text("Not calibrated").first.wait_for()
    assert site(service, "P017") == ("right", None)


def test_what_was_changed_meanwhile_is_shown_and_can_be_done_all_the_same(tab: Any, service: Service) -> None:
    form = open_form(tab, service, "A5")
    with service.client() as client:
        client.put("/v1/participants/A5/muscle", json={"side": "right"})
    form.get_by_label("Side").select_option("left")
    save(form)
    question = tab.get_by_role("dialog", name="This was changed since you saw it")
    expected(question.get_by_role("row").filter(has_text="set muscle")).to_contain_text("side right")
    expected(question).to_contain_text("administrator")
    again = question.get_by_role("button", name="Do it all the same")
    expected(again).to_be_disabled()  # it is read first
    assert tab.evaluate(UNCOVERED) and site(service, "A5") == ("right", None)
    again.click()
    tab.get_by_text("left").first.wait_for()
    expected(question).to_have_count(0)
    assert site(service, "A5") == ("left", None)


def test_without_an_answer_it_says_that_nothing_was_written_and_keeps_what_was_typed(tab: Any, service: Service):
    form = open_form(tab, service, "A6")
    form.get_by_label("Muscle").fill("triceps")
    tab.route("**/A6/muscle*", lambda route: route.abort())
    save(form)
    expected(tab.locator("#refused")).to_contain_text("Not written: the service does not answer.")
    assert form.get_by_label("Muscle").input_value() == "triceps" and site(service, "A6") == (None, None)


def test_a_file_is_sent_and_its_model_is_shown(tab: Any, service: Service, tmp_path: Path) -> None:
    open_form(tab, service, "A7")
    (tmp_path / "record.csv").write_text("time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n")
    tab.get_by_text("Upload a recording of another tool").click()
    tab.get_by_label("HDF5, MAT or Parquet").set_input_files(tmp_path / "record.csv")
    tab.get_by_role("button", name="Upload and identify").click()
    tab.wait_for_url("**/models/M-*")
    assert tab.errors == []

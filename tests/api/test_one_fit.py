"""A model has one figure that says how good it is: the same on every page, with the pulses it was found on."""

from __future__ import annotations

import re

from api.models.followed import followed
from tests.api.conftest import Service, run_test, shared_service
from tests.api.test_access import signed_in

service = shared_service()


def test_new_pulses_come_first() -> None:
    both = {"fit_percent": 98.5, "ceiling_percent": 99.0, "held_out_fit_percent": 97.9}
    assert (followed(both).percent, followed(both).where) == (97.9, "On pulses not used for fitting")
    crossed = {**both, "held_out_by": "cross-validation"}
    assert followed(crossed).where == "On parts of the recording that were left out in turn"
    alone = followed({**both, "held_out_fit_percent": None})
    assert (alone.percent, alone.ceiling_percent, alone.where) == (98.5, 99.0, "On the pulses that it was fitted to")


def test_every_page_shows_the_same_fit(service: Service) -> None:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "F1"})
        first, second = (run_test(http, "F1")["model_id"] for _ in range(2))
    pages = ("/", "/participants/F1", "/participants/F1/trend", f"/compare?model={first}&model={second}",
             f"/models/{first}", f"/models/{first}/report")  # fmt: skip
    with signed_in(service) as browser:
        for place in pages:
            page = browser.get(place).text
            assert "97.9" in page and 'title="On pulses not used for fitting"' in page, place
            page = re.sub(r"<(script|svg)\b.*?</\1>", "", page, flags=re.DOTALL)
            others = page.count("98.5")  # on the pulses that it was fitted to; said so where it is shown
            assert others == page.count("On fitted pulses</span><b>98.5"), place

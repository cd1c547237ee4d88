"""The story of a model as a file: where it failed, what was added, how the error fell, and why that ended."""

from __future__ import annotations

import httpx
import pytest

from stimrig.identify.healing import healed_places, place_words
from tests.api.conftest import Service, run_test, signed_in


@pytest.fixture
def model(client: httpx.Client, participant: str) -> str:
    """The model of a test."""
    return run_test(client, participant)["model_id"]


def test_the_story_begins_with_what_is_missing_and_ends_with_the_error(
    service: Service, client: httpx.Client, model: str
) -> None:
    client.get(f"/v1/models/{model}/diagnosis")
    with signed_in(service) as page:
        first = page.get(f"/models/{model}/story.html").text
        assert "What is missing" in first and "The held-out error is" in first and "To decide between" in first
        last = client.post(f"/v1/models/{model}/improve").json()["versions"][-1]["id"]
        client.get(f"/v1/models/{last}/diagnosis")
        told = page.get(f"/models/{last}/story.html")
        assert told.headers["content-disposition"] == "attachment" and told.text.count('class="still"') == 3
        assert "The held-out error did not fall" in told.text and "What was missing" in told.text


def test_the_improvement_that_a_diagnosis_found_is_not_searched_again(
    service: Service, client: httpx.Client, model: str
) -> None:
    client.get(f"/v1/models/{model}/diagnosis")
    slow = service.data / "recordings" / "slow"
    slow.write_text("0.5")  # a search that began now would stand still
    assert client.post(f"/v1/models/{model}/improve", timeout=30).status_code == 201


def test_a_place_is_healed_where_only_noise_is_left_there() -> None:
    times, place = [0.0, 0.5, 1.0, 1.5], {"start_s": 0.0, "end_s": 0.6, "text": "ramp"}

    def comparison(*residual_nm: float) -> dict:
        return {"noise_sd_nm": 0.1, "where": [place], "series": {"time_s": times, "residual_nm": list(residual_nm)}}

    first = comparison(1.0, -1.0, 0.0, 0.0)
    for left_nm, healed, words in (
        (0.1, True, "fell"), (0.5, False, "more than the noise"), (1.0, False, "as before"),
        (1.1, False, "rose from 1 to 1.1"), (0.9999, False, "is 1 N·m, as before"),
    ):  # fmt: skip
        (found,) = healed_places(first, comparison(left_nm, -left_nm, 9.0, 9.0))
        assert (found["before_nm"], found["after_nm"], found["healed"]) == (1.0, left_nm, healed)
        assert words in place_words(found)

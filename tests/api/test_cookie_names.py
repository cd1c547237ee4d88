"""Browsers tell hosts apart, not ports: services on one host leave one another's sessions alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.api.centre.conftest import run_centre
from tests.api.conftest import STUB, TOKEN, run_service

PASSWORD = "correct horse battery"


@pytest.fixture
def urls(tmp_path: Path, short_dir: Path) -> Iterator[list[str]]:
    """Services of two rigs, and a centre."""
    for one in run_service(tmp_path / "a", short_dir, STUB):
        for other in run_service(tmp_path / "b", tmp_path, STUB):
            for centre in run_centre(tmp_path / "centre"):
                yield [one.url, other.url, centre.url]


def test_one_browser_stays_signed_in_at_every_service_of_a_host(urls: list[str]) -> None:
    for url in urls:
        answer = httpx.post(
            f"{url}/v1/users", headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60,
            json={"name": "Ada", "password": PASSWORD, "scopes": ["administer"]},
        )  # fmt: skip
        assert answer.status_code == 201, answer.text
    with httpx.Client(timeout=60) as browser:
        csrf = {}
        for url in urls:
            csrf[url] = browser.post(f"{url}/v1/sessions", json={"name": "Ada", "password": PASSWORD}).json()["csrf"]
        assert len(browser.cookies) == len(urls)
        assert [browser.get(f"{url}/v1/users").status_code for url in urls] == [200, 200, 200]
        browser.delete(f"{urls[0]}/v1/sessions/current", headers={"X-CSRF-Token": csrf[urls[0]]}).raise_for_status()
        assert [browser.get(f"{url}/v1/users").status_code for url in urls] == [401, 200, 200]

"""The two forms that work without scripts, sign-in and stop: whatever is posted to them is a problem in words."""

from __future__ import annotations

import pytest
from fastapi.routing import APIRoute

from stimrig.api.web import pages
from stimrig.api.web.app import routers
from tests.api.conftest import HTML, Service, shared_service

FORM, PARTS = "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"
service = shared_service()


def part(name: str, value: bytes, more: str = "") -> bytes:
    head = f'--x\r\nContent-Disposition: form-data; name="{name}"{more}\r\n\r\n'
    return head.encode() + value + b"\r\n--x--\r\n"


BODIES: list[tuple[str, bytes]] = [
    ("", b""), (FORM, b""), (PARTS, b""), ("multipart/form-data", b"x"), ("application/json", b"{}"),
    ("application/json", b"[1]"), ("text/plain", b"x"), (FORM, b"&&==&%zz=%"), (FORM, b"\xff=\xfe"),
    (FORM, b"a=1&" * 2000), (PARTS, part("name", b"\xff\xfe")), (PARTS, part("name", b"x", '; filename="x.csv"')),
    *((f"{PARTS}; charset={charset}", part("name", b"+2AA-")) for charset in ("none", "idna", "utf-7", "punycode")),
    (f"{FORM}; charset=utf-7", b"name=%ff"), (FORM, b"name=%00&password=%00"), (FORM, b"token=%d7%ff%ef%bb%bf"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "answers"), [("/v1/sessions", {400, 401, 429}), ("/v1/stop", {200})])
def test_an_odd_form_is_a_problem_in_words_and_a_stop_is_a_stop(
    service: Service, path: str, answers: set[int]
) -> None:  # fmt: skip
    with service.client(None if path == "/v1/sessions" else "administrator-token-of-the-tests", headers=HTML) as client:
        for kind, body in BODIES:
            answer = client.post(path, content=body, headers={"content-type": kind}, follow_redirects=True)
            assert answer.status_code in answers, (kind, body[:60], answer.status_code)
            assert "<h1>" in answer.text


def test_a_form_is_utf_8(service: Service) -> None:
    with service.client(None, headers=HTML) as client:
        kind = f"{PARTS}; charset=utf-7"
        answer = client.post("/v1/sessions", content=part("name", b"+2AA-"), headers={"content-type": kind})
        assert answer.status_code == 400 and "UTF-8" in answer.text
        token = part("token", b"administrator-token-of-the-tests")
        answer = client.post("/v1/sessions", content=token, headers={"content-type": f'{PARTS}; charset="UTF-8"'})
        assert answer.status_code in (303, 429), answer.text


def test_pages_only_read_and_are_few() -> None:
    found = [route for router in routers(pages) for route in router.routes if isinstance(route, APIRoute)]
    assert not [route.path for route in found if route.methods != {"GET"}]
    assert len(found) <= 30

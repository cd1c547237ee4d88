"""Whatever is posted to the page's own routes, by whom it may be: a page, or a problem in words; never a 500."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from fastapi.routing import APIRoute

from stimrig.api.web import pages
from stimrig.api.web.app import routers
from stimrig.rig.messages import LABEL_TITLES
from tests.api.conftest import HTML, TOKEN, Service, play_test, shared_service

FOLDER = Path(pages.__file__).parent
FIELDS = r'<(?:input|select|textarea)[^>]*\bname="(\w+)"', r"(\w+): (?:Text|Annotated\[.*Form\()"
"""A field of a template, and one that a route reads."""
SOURCES = [path.read_text("utf-8") for kind in ("templates/*.html", "*.py") for path in FOLDER.glob(kind)]
FROM_MACROS = (
    "seen", "step_us", "max_torque_nm", "gain_percent", "threshold_percent", "time_scale_percent", "angle_deg",
    "angle_from_deg", "angle_to_deg", *LABEL_TITLES,
)  # fmt: skip
NAMES = sorted({*FROM_MACROS} | {name for text in SOURCES for field in FIELDS for name in re.findall(field, text)})
ODD = [
    "", " ", "0", "-1", "1e-320", "1e999", "nan", "9,5", "\0", "\ufeff", "٣", "ä" * 600, "../..", "{}", "<b>", "\ud7ff",
]  # fmt: skip
FORM, PARTS = "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"


def part(name: str, value: bytes, more: str = "") -> bytes:
    head = f'--x\r\nContent-Disposition: form-data; name="{name}"{more}\r\n\r\n'
    return head.encode() + value + b"\r\n--x--\r\n"


BODIES: list[tuple[str, bytes]] = [
    ("", b""), (FORM, b""), (PARTS, b""), ("multipart/form-data", b"x"), ("application/json", b"{}"),
    ("application/json", b"[1]"), ("text/plain", b"x"), (FORM, b"&&==&%zz=%"), (FORM, b"\xff=\xfe"),
    (FORM, b"a=1&" * 2000), (PARTS, part("effect", b"\xff\xfe")), (PARTS, part("effect", b"x", '; filename="x.csv"')),
    *((f"{PARTS}; charset={charset}", part("effect", b"+2AA-")) for charset in ("none", "idna", "utf-7", "punycode")),
    (f"{FORM}; charset=utf-7", b"effect=%ff"),
]  # fmt: skip


service = shared_service()


@pytest.fixture(scope="module")
def known(service: Service) -> dict[str, str]:
    """What is there, by the name it has in an address."""
    with service.client() as client:
        test = play_test(client, "P017")
        client.post("/v1/participants/P017/calibration")
    return {
        "code": "P017",
        "model_id": test["model_id"],
        "direction": "up",
        "threshold": "sensory",
        "job_id": "none",
        "test_id": test["id"],
    }


def posts() -> list[str]:
    """Every address of the page that takes a POST; a calibration first, while one is open."""
    found = {
        route.path
        for router in routers(pages)
        for route in router.routes
        if isinstance(route, APIRoute) and "POST" in route.methods
    }
    return sorted(found, key=lambda path: ("calibration" not in path, path.endswith("discard"), path))


@pytest.mark.parametrize("apart", [4, pytest.param(1, marks=pytest.mark.campaign)])
def test_an_odd_form_is_a_problem_in_words(service: Service, known: dict[str, str], apart: int) -> None:
    """With an administrator's token, so that no form is out of date before its fields are looked at.

    Of the odd values and of the bodies, which all forms read alike, one in `apart` goes to each address in turn.
    """
    fields = [dict.fromkeys(NAMES, value) for value in ODD]
    assert len(NAMES) > 50
    failed, tried = [], 0
    with service.client(TOKEN, headers=HTML) as client:
        for number, each in enumerate(posts()):
            path = re.sub(r"\{(\w+)[^}]*\}", lambda match: known.get(match[1], "none"), each)
            bodies = BODIES if path.endswith("/effects") else BODIES[number % apart :: apart]  # some name its field
            sent = [client.post(path, content=body, headers={"content-type": kind}) for kind, body in bodies]
            sent += [client.post(path, data=each) for each in fields[number % apart :: apart]]
            tried += len(sent)
            failed += [
                (path, answer.status_code, answer.request.headers.get("content-type"), answer.request.content[:60])
                for answer in sent
                if answer.status_code >= 500
            ]
    assert not failed, (len(failed), tried, failed[:20])
    assert tried >= len(posts()) * (len(ODD) + len(BODIES)) // apart > 250


def test_a_form_is_utf_8(service: Service, known: dict[str, str]) -> None:
    with service.client(headers=HTML) as client:
        kind = f"{PARTS}; charset=utf-7"
        answer = client.post("/participants", content=part("code", b"+2AA-"), headers={"content-type": kind})
        assert answer.status_code == 400 and "UTF-8" in answer.text
        kind = f'{PARTS}; charset="UTF-8"'
        answer = client.post("/participants", content=part("code", b"P018"), headers={"content-type": kind})
        assert answer.status_code == 303, answer.text

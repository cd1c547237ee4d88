"""A day of a clinic by every route and on every page of a service with a fake rig: what each answer is."""

from __future__ import annotations

import json
import os
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from argon2 import PasswordHasher

from stimrig.api.clock import Clock
from stimrig.api.people import accounts
from tests.api.conftest import STUB, TOKEN, Service, let_go, run_service, wait_done
from tests.api.fake_arm import still
from tests.frozen.answers import condensed, words_of

BEGAN_S = 1_800_000_000.0
HTML = {"Accept": "text/html"}
PASSWORD = "correct horse battery"
HEADS = "location", "etag", "content-disposition", "content-language", "allow", "retry-after", "www-authenticate"
VOLATILE = (
    (re.compile(r'^"\d{6,}"$'), '"<version>"'),
    (re.compile(r"\b[A-Z]\d{8}T\d{6}(?:-\w+)*(?:\.\d+\.[0-9a-f]{8})?"), "<id>"),
    (re.compile(r"\b[MTRN]\w*-?[0-9a-f]{8,}|\b[0-9a-f]{12,}\b"), "<id>"),
    (re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+Z?"), "<time>"),
    (re.compile(r"\b\d{1,2}:\d\d(?::\d\d)?(?:\.\d+)?\b"), "<hh:mm>"),
    (re.compile(r"(name=\W?(?:csrf|seen|right)\W+value=)[^ >]+"), r"\1<secret>"),
    (re.compile(r"(stimrig_session_|stimrig_)[\w-]{4,}"), r"\1<secret>"),
    (re.compile(r"http://127\.0\.0\.1:\d+"), "<service>"),
)


@contextmanager
def served(folder: Path) -> Iterator[Service]:
    """A service on a day that is always the same, its workers in this process."""
    ahead_s, zone = BEGAN_S - time.time(), os.environ.get("TZ")
    quick = partial(PasswordHasher, time_cost=1, memory_cost=64, parallelism=1)
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory(prefix="stimrig-") as short:
        patch.setattr(accounts, "PasswordHasher", quick)
        patch.setattr(Clock, "unix_s", lambda _clock: time.time() + ahead_s)
        patch.setenv("TZ", "UTC")
        time.tzset()
        yield from run_service(folder, Path(short), STUB)
    os.environ.pop("TZ", None) if zone is None else os.environ.update(TZ=zone)
    time.tzset()


class Day:
    """Asks, and writes down what is answered.

    Parameters
    ----------
    service
        The service.
    """

    def __init__(self, service: Service) -> None:
        self.service = service
        self.http = service.client(follow_redirects=False)
        self.found: dict[str, Any] = {}
        self.names: dict[str, str] = {}
        """What a random id stands for."""

    def ask(self, method: str, path: str, body: Any = None, note: str = "", http: Any = None, **more: Any) -> Any:
        """An answer, which is kept; the place of an id in `path` is its name in brackets."""
        ids = {name.strip("<>"): value for value, name in self.names.items()}
        given = {"json": body} if body is not None else {}
        answer = (http or self.http).request(method, path.format(**ids), **given, **more)
        key = " ".join(filter(None, [note, method, path, json.dumps(body) if body is not None else ""]))
        while key in self.found:
            key += " again"
        self.found[key] = self.kept(answer)
        return answer

    def name(self, name: str, value: str) -> str:
        """From now on this id is shown by its name."""
        self.names[value] = f"<{name}>"
        return value

    def kept(self, answer: httpx.Response) -> dict[str, Any]:
        kind = answer.headers.get("content-type", "")
        kept: dict[str, Any] = {"status": answer.status_code, "type": kind}
        kept |= {name: self.masked(answer.headers[name]) for name in HEADS if name in answer.headers}
        if not answer.content:
            return kept
        if "json" in kind and not kind.endswith("jsonl"):
            kept["json"] = condensed(self.masked(answer.json()), self.service.data)
        elif "html" in kind:
            kept["words"] = self.masked(words_of(self.masked(answer.text), self.service.data))
        elif "hdf5" in kind:
            kept["bytes"] = len(answer.content) > 1000
        elif "version=0.0.4" in kind or "openmetrics" in kind:
            kept["names"] = sorted({re.split(r"[ {]", line)[0] for line in answer.text.split("\n") if line[:1] != "#"})
        else:
            lines = answer.text.split("\n")
            kept["text"] = self.masked([*lines[:30], f"{len(lines)} lines"])
        return kept

    def masked(self, value: Any) -> Any:
        if isinstance(value, dict):
            versions = {name: "<version>" for name, one in value.items() if name == "version" and isinstance(one, int)}
            return {self.masked(name): self.masked(one) for name, one in value.items()} | versions
        if isinstance(value, list):
            return [self.masked(one) for one in value]
        if not isinstance(value, str):
            return value
        for one in sorted(self.names, key=len, reverse=True):
            value = value.replace(one, self.names[one])
        for pattern, word in VOLATILE:
            value = pattern.sub(word, value)
        return value

    def begun(self, name: str, speed: float, **body: Any) -> str:
        """A test that is begun; how far it is then, nobody knows."""
        self.service.rig.speed = speed
        answer = self.ask("POST", "/v1/tests", {"participant": "P1", **body}, note=name)
        for key in ("progress", "time_left_s", "segment", "state"):
            self.found[list(self.found)[-1]]["json"].pop(key, None)
        return self.name(f"test_{name}", answer.json()["id"])

    def played(self, name: str, **body: Any) -> dict[str, Any]:
        """A test by REST to its end."""
        done = wait_done(self.http, self.begun(name, 600.0, **body))
        let_go(self.http)
        for kind in ("recording", "model"):
            if done.get(f"{kind}_id"):
                self.name(f"{kind}_{name}", done[f"{kind}_id"])
        self.ask("GET", f"/v1/tests/{{test_{name}}}")
        return done


def of_day(folder: Path) -> dict[str, Any]:
    """Every answer."""
    with served(folder) as service:
        day = Day(service)
        day.ask("GET", "/openapi.json")
        people(day)
        calibration(day)
        tests(day)
        models(day)
        joint(day)
        everything(day)
        pages(day)
        day.http.close()
    return day.found


def people(day: Day) -> None:
    """Participants, notes, persons, tokens."""
    ask = day.ask
    ask("POST", "/v1/participants", {"code": "P1", "side": "left", "muscle": "biceps brachii"})
    ask("POST", "/v1/participants", {"code": "P2"})
    wild = {"code": "P3", "profile": {"current_ma": 900}}
    for body in ({"code": "P1"}, {"code": "no name"}, wild, {"codes": "P4"}, []):
        ask("POST", "/v1/participants", body)
    ask("PUT", "/v1/participants/P1/profile", {"max_torque_nm": 25.0, "max_pulse_width_us": 280.0})
    ask("PUT", "/v1/participants/P1/profile", {"current_ma": 18.0}, headers={"If-Match": '"0"'})
    ask("PUT", "/v1/participants/P1/profile", {"max_torque_nm": "much"})
    ask("PUT", "/v1/participants/P2/muscle", {"side": "right", "muscle": "triceps brachii", "placement": "2 cm distal"})
    note = ask("POST", "/v1/participants/P1/notes", {"kind": "electrodes", "text": "2 cm <b>distal</b>"}).json()
    ask("POST", "/v1/participants/P1/notes", {"kind": "nothing", "text": ""})
    day.name("note_id", str(note["id"]))
    ask("POST", "/v1/participants/P1/notes/{note_id}/strike")
    ask("POST", "/v1/participants/P1/notes/{note_id}/strike")
    for archived in (True, True, False):
        ask("PUT", "/v1/participants/P2/archived", {"archived": archived})
    ask("POST", "/v1/users", {"name": "Ada", "password": PASSWORD})
    ask("POST", "/v1/users", {"name": "Ben", "password": PASSWORD, "scopes": ["read-live"]})
    ask("POST", "/v1/users", {"name": "Eve", "password": "short"})
    ask("PUT", "/v1/users/Ben/password", {"password": PASSWORD + "!"})
    ask("DELETE", "/v1/users/Ben")
    made = ask("POST", "/v1/tokens", {"name": "script", "scopes": ["read-live"]}).json()
    day.name("token", made["token"])
    day.name("token_id", next(one["id"] for one in ask("GET", "/v1/tokens").json() if one["name"] == "script"))
    ask("POST", "/v1/tokens", {"name": "script", "scopes": ["everything"]})
    with day.service.client(None) as http:
        ask("POST", "/v1/sessions", {"name": "Ada", "password": "wrong"}, http=http)
        ask("POST", "/v1/sessions", {"name": "Ada", "password": PASSWORD}, http=http)
        for path, body in (("lock", None), ("unlock", {"password": "wrong"}), ("unlock", {"password": PASSWORD})):
            ask("POST", f"/v1/sessions/{path}", body, http=http)
        ask("POST", "/v1/sessions/confirm", {"password": PASSWORD}, http=http)
        ask("DELETE", "/v1/sessions/current", http=http)


def calibration(day: Day) -> None:
    """A guided calibration, one that is broken off, and a stop."""
    at = "/v1/participants/P1/calibration"
    day.ask("GET", at)
    day.ask("POST", at, {"step_us": 10.0, "current_ma": 900.0})
    day.ask("POST", at, {"step_us": 10.0})
    day.ask("POST", at + "/mark", {"threshold": "sensory"})
    for threshold in ("sensory", "motor", "comfort"):
        day.ask("POST", at + "/step", {"direction": "up"})
        day.ask("POST", at + "/mark", {"threshold": threshold})
    for direction in ("fine", "down", "repeat", "up", "up", "sideways"):
        day.ask("POST", at + "/step", {"direction": direction})
    day.ask("GET", at)
    day.ask("POST", at + "/finish", {})
    day.ask("GET", "/v1/participants/P1")
    day.ask("POST", "/v1/stop", {"reason": "a cramp"})
    day.ask("POST", "/v1/tests", {"participant": "P1"}, note="stopped")
    day.ask("POST", "/v1/rearm")


def tests(day: Day) -> None:
    """Every kind of test."""
    day.ask("GET", "/v1/rig")
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1}}
    widths = {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [10.0 * k for k in range(25)]}}
    for body in ({"participant": "P1"}, {"participant": "P1", "segments": [rest, {"name": "x", "sequence": "polka"}]}):
        day.ask("POST", "/v1/preview", body)
        if "segments" in body:
            day.ask("POST", "/v1/tests", body)
    day.played("first", ran_by="Jörg Müller")
    day.played("second", protocol="short")
    day.played("sequence", kind="sequence", segments=[rest, widths])
    for body in ({"participant": "P9"}, {"participant": "P1", "kind": "held"}):
        day.ask("POST", "/v1/tests", body)
    test_id, rig = day.begun("stopped", 1e-3), day.service.rig
    day.ask("POST", "/v1/tests", {"participant": "P2"}, note="meanwhile")
    rig.stopped_by = "nurse"
    day.service.rig_thread.loop.call_soon_threadsafe(rig._stop.set)
    wait_done(day.http, test_id)
    let_go(day.http)
    day.ask("POST", "/v1/rearm")
    for more in ({"max_torque_time_nm_s": 4.0}, {"target": {"curve_percent": 0.01}}):
        day.ask("POST", "/v1/tests", {"participant": "P1", "kind": "adaptive", **more})
    day.service.rig.speed = 600.0
    day.ask("PUT", "/v1/tests/{test_first}/ran-by", {"ran_by": "Ben"})
    day.ask("POST", "/v1/tests/{test_first}/enough")


def models(day: Day) -> None:
    """Compare, diagnose, add, approve, fetch, follow."""
    at = "/v1/models/{model_first}"
    day.ask("GET", "/v1/participants/P1/model")
    for path in ("comparison", "curves", "diagnosis?wait=true"):
        day.ask("GET", f"{at}/{path}")
    for body in ({"effects": ["phlogiston"]}, {"effects": ["tremor"]}, {"effects": []}):
        day.ask("POST", at + "/effects?wait=true", body)
    added = day.ask("POST", at + "/effects?wait=true", {"effects": ["fatigue"], "reason": "it tires"})
    day.name("model_added", added.json()["id"])
    day.ask("GET", "/v1/models/{model_added}/diagnosis?wait=true")  # else its page shows it or not
    day.ask("POST", "/v1/models/{model_second}/improve?wait=true")
    day.ask("POST", at + "/approve", {"tracking": {"gain_percent": 500}})
    day.ask("POST", at + "/approve", {"reason": "follows well", "tracking": {"gain_percent": 15}})
    served = day.ask("GET", "/v1/participants/P1/model")
    day.ask("GET", "/v1/participants/P1/model", headers={"If-None-Match": served.headers["etag"]}, note="known")
    widths = {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [10.0 * k for k in range(25)]}}
    day.played("trial", kind="sequence", segments=[widths])
    day.ask("GET", "/v1/participants/P1/model?tracked=true")
    day.ask("GET", "/v1/participants/P1/tracking")
    day.ask("POST", at + "/prediction", {"pulse_width_us": [0.0, 100.0, 200.0]})
    day.ask("POST", at + "/prediction", {"pulse_width_us": ["wide"]})
    day.ask("POST", at + "/widths", {"reference_torque_nm": [0.0, 1.0, 2.0]})
    day.ask("POST", "/v1/models/{model_added}/approve", {})
    day.ask("POST", "/v1/models/{model_second}/reject", {"reason": "worse"})
    rows = b"".join(b"%.3f,0,0.1,rest\n" % (k / 40) for k in range(80))
    at, head = "/v1/participants/P2/recordings", {"Content-Type": "text/csv"}
    for data in (b"time_s,pulse_width_us,torque_nm,segment\n" + rows, b"a,b\n1,2\n"):
        day.ask("POST", at, note=f"{len(data)} bytes", content=data, headers=head)


def joint(day: Day) -> None:
    """A joint's angle: without a sensor, with one, its poses, a held test."""
    day.ask("POST", "/v1/rig/angle/pose", {"angle_rad": 0.2})
    day.ask("GET", "/v1/rig/angle")
    day.service.rig.arm.way = still(1.13)
    end_s = time.monotonic() + 60
    while not day.http.get("/v1/rig").json()["angle"]["present"]:
        assert time.monotonic() < end_s
        time.sleep(0.05)
    day.ask("PUT", "/v1/participants/P1/profile", {"angle_range_rad": [0.35, 1.92]})
    for angle in (0.0, 0.2, 1.5):
        day.ask("POST", "/v1/rig/angle/pose", {"angle_rad": angle})
    day.played("held", kind="held", angle={"target_rad": 1.13})
    day.ask("POST", "/v1/participants/P1/models?wait=true", {"recordings": ["none"]})


def everything(day: Day) -> None:
    """Every GET of the document, now that there is something to tell."""
    for path, methods in sorted(day.http.get("/openapi.json").json()["paths"].items()):
        if "get" not in methods:
            continue
        for which in ("first", "second") if "_id}" in path else ("",):
            filled = re.sub(r"\{(model|test|recording)_id\}", rf"{{\1_{which}}}", path)
            filled = filled.replace("{job_id}", "none").replace("{search_id}", "none").replace("{code}", "P1")
            day.ask("GET", filled)
    day.ask("GET", "/v1/participants?q=p&archived=true")


def pages(day: Day) -> None:
    """What a person sees and sends."""
    seen = (
        "/", "/?q=p2", "/?archived=1", "/participants/P1", "/participants/P2", "/participants/P1/next",
        "/participants/P1/calibration", "/participants/P1/trend", "/participants/P1/joint",
        "/models/{model_first}", "/models/{model_added}", "/models/{model_second}",
        "/models/{model_first}/report", "/tests/{test_first}", "/tests/{test_stopped}",
        "/tests/{test_held}", "/tests/{test_trial}", "/rig/angle",
        "/rig/now", "/administration", "/sign-in", "/locked", "/models/none", "/nowhere", "/docs",
    )  # fmt: skip
    with day.service.client(None, headers=HTML, follow_redirects=False) as http:
        day.ask("GET", "/", note="page nobody", http=http)
        day.ask("GET", "/sign-in", note="page nobody", http=http)
        http.post("/v1/sessions", data={"name": "Ada", "password": "wrong"})
        day.found["page signed in"] = day.kept(http.post("/v1/sessions", data={"token": TOKEN, "next": "/"}))
        for path in seen:
            day.ask("GET", path, note="page", http=http)

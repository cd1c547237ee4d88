"""Signing in through a provider: a real one, one that is hostile, one that is silent; accounts, roles, stop."""

from __future__ import annotations

import queue
import re
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest

from stimrig.api.errors import SettingsError
from stimrig.api.people import provider
from stimrig.api.settings import Settings
from stimrig.api.store.tables import AuditEntry
from tests.api import hostile_provider
from tests.api.centre.conftest import run_centre
from tests.api.conftest import HTML, NO_TLS, PATIENCE_S, STUB, Service, run_service, run_test, soon
from tests.api.hostile_provider import CLIENT, EC, ED, SECRET, STRANGER, Double, encoded
from tests.api.test_overtaken import TRIAL
from tests.api.test_people import PASSWORD, standing_still

PUBLIC = "https://rig.example.org"
ROLES = "stim-clinicians=clinician, stim-readers=reader"


def settings_for(issuer: str, **more: Any) -> Any:
    return {
        "oidc_issuer": issuer, "oidc_public_url": PUBLIC, "oidc_client_id": CLIENT, "oidc_client_secret": SECRET,
        "oidc_name": "the clinic", "oidc_roles": ROLES, **more,
    }  # fmt: skip


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[tuple[Service, Double]]:
    with hostile_provider.running() as double:
        for service in run_service(tmp_path_factory.mktemp("shared"), short_dir, STUB, **settings_for(double.issuer)):
            yield service, double


@pytest.fixture
def double(shared: tuple[Service, Double]) -> Iterator[Double]:
    """As it was, whatever a test tells it."""
    service, double = shared
    as_it_is = {name: value.copy() if hasattr(value, "copy") else value for name, value in vars(double).items()}
    forget(service)
    yield double
    vars(double).clear()
    vars(double).update(as_it_is)
    forget(service)


@pytest.fixture
def service(shared: tuple[Service, Double]) -> Service:
    return shared[0]


def forget(service: Service) -> None:
    """What the service knows of its provider, and what it has counted."""
    service.context.provider._about = service.context.provider._keys = None
    service.context.guesses._callbacks._counts.clear()


@pytest.fixture
def visitor(service: Service) -> Iterator[httpx.Client]:
    with service.client(token=None, auth=None, headers=HTML, follow_redirects=False) as visitor:
        yield visitor


def begun(visitor: httpx.Client, next: str = "/", **more: str) -> str:
    """The provider's address to which the button leads."""
    answer = visitor.get("/sign-in/provider", params={"next": next, **more})
    assert answer.status_code == 303, answer.text
    return answer.headers["location"]


def back(visitor: httpx.Client, given: dict[str, str]) -> httpx.Response:
    return visitor.get("/sign-in/callback", params=given)


def signs_in(visitor: httpx.Client, double: Double, next: str = "/", **more: str) -> httpx.Response:
    return back(visitor, double.code_for(begun(visitor, next, **more)))


def status(visitor: httpx.Client, path: str = "/v1/rig") -> int:
    """What a program hears that has the browser's cookies."""
    return visitor.get(path, headers={"Accept": "application/json"}).status_code


def why(service: Service) -> str:
    """Of the newest refusal, in the trail."""
    with service.client() as admin:
        entry = admin.get("/v1/audit").json()["entries"][-1]
    assert entry["action"] == "sign in refused", entry
    return entry["detail"]["why"]


# ---- all is well


def test_a_group_makes_an_account_and_says_its_role(service: Service, double: Double, visitor: httpx.Client) -> None:
    double.groups, double.sub = ["others", "stim-clinicians"], "by-group"
    address = begun(visitor, "/participants/P1?all=1")
    asked = {name: texts[0] for name, texts in parse_qs(urlsplit(address).query).items()}
    assert asked["redirect_uri"] == f"{PUBLIC}/sign-in/callback" and asked["code_challenge_method"] == "S256"
    assert asked["response_type"] == "code" and asked["prompt"] == "login", "a rig's screen is shared"
    cookie = visitor.get("/sign-in/provider").headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=lax" in cookie
    answer = signs_in(visitor, double, "/participants/P1?all=1")
    assert answer.status_code == 200 and answer.headers["refresh"] == "0; url=/participants/P1?all=1"
    own, flow = answer.headers.get_list("set-cookie")
    assert "SameSite=strict" in own + flow and "stimrig_sign_in" in own + flow
    assert status(visitor) == 200
    with service.client() as admin:
        users = {user["name"]: user for user in admin.get("/v1/users").json()}
        assert users["Ada Çelik"]["scopes"] == ["read-live", "run-test", "read-model", "approve-model"]
        actions = [entry["action"] for entry in admin.get("/v1/audit").json()["entries"]]
        assert actions[-3:] == ["add user", "link sign-in", "sign in"]
        assert double.sub not in str(admin.get("/v1/audit").json()), "a provider's subject is no business of the trail"
    assert signs_in(visitor, double).status_code == 200, "and the next time it is the same account"
    with service.client() as admin:
        assert [user["name"] for user in admin.get("/v1/users").json()].count("Ada Çelik") == 1


def test_what_a_group_gave_it_takes(service: Service, double: Double, visitor: httpx.Client) -> None:
    double.groups, double.sub, double.claims = ["stim-clinicians"], "less-and-less", {"name": "Grace"}
    assert signs_in(visitor, double).status_code == 200
    with service.client(token=None, auth=None, headers=HTML, follow_redirects=False) as elsewhere:
        double.groups = ["stim-readers"]
        assert signs_in(elsewhere, double).status_code == 200
        assert status(visitor) == 401, "sessions with more rights end"
        assert status(elsewhere) == 200 and status(elsewhere, "/v1/participants") == 403
        double.groups = []
        refused = signs_in(elsewhere, double)
        assert refused.status_code == 403 and status(elsewhere) == 401


@pytest.mark.parametrize("groups", [["stim-readers"], []])
def test_a_controllers_key_falls_with_the_group_of_who_made_it(
    service: Service, double: Double, visitor: httpx.Client, groups: list[str]
) -> None:
    double.groups, double.sub, double.claims = ["stim-clinicians"], f"maker-{groups}", {"name": "Made It"}
    assert signs_in(visitor, double).status_code == 200
    csrf = re.search(r'name="csrf" value="([^"]+)"', visitor.get("/").text)
    head = {"X-CSRF-Token": csrf[1] if csrf else "", "Accept": "application/json"}
    code = f"K{len(groups)}"
    with service.client() as admin:
        admin.post("/v1/rearm")
        admin.post("/v1/participants", json={"code": code})
        test = run_test(admin, code)
        assert admin.post(f"{test['model_url']}/approve", json={"reason": "good"}).status_code == 200
        head["If-Match"] = admin.get(f"/v1/participants/{code}").headers["etag"]
    plan = {"name": "ilc", "current_ma": 8, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}
    assert signs_in(visitor, double, again="1").status_code == 200
    made = visitor.post(f"/v1/participants/{code}/keys", json=plan, headers=head)
    assert made.status_code == 201, made.text
    with service.client(token=made.json()["key"]) as controller:
        assert controller.get(f"/v1/participants/{code}/model").status_code == 200
        speed, service.rig.speed = service.rig.speed, 0.1
        plays = controller.post("/v1/tests", json={"participant": code, **TRIAL})
        assert plays.status_code == 202
        double.groups = groups
        assert signs_in(visitor, double).status_code == (200 if groups else 403)
        assert controller.get(f"/v1/participants/{code}/model").status_code == 401
        # what plays by that right ends, as where a key is revoked
        soon(lambda: [one for one in service.rig.withdrawn if one.test_id == plays.json()["id"]])
        service.rig.speed = speed
        assert controller.post("/v1/stop").status_code == 200, "a stop is for everybody who had a key"


def test_who_has_no_group_hears_so_and_an_administrator_links(
    service: Service, double: Double, visitor: httpx.Client
) -> None:
    double.sub, double.claims = "nobody-yet", {"name": "Linus", "email": "linus@example.org"}
    with service.client() as admin:
        assert admin.post("/v1/users", json={"name": "Linus", "password": PASSWORD}).status_code == 201
        refused = signs_in(visitor, double)
        assert refused.status_code == 403 and "nobody-yet" in refused.text and "no-role" in why(service)
        assert status(visitor) == 401, "the same name says nothing"
        assert admin.put("/v1/users/Linus/provider", json={"subject": "nobody-yet"}).status_code == 204
        answer = signs_in(visitor, double)
        assert answer.status_code == 200 and "Linus" in answer.text
        assert status(visitor) == 200
        assert visitor.post("/v1/sessions", json={"name": "Linus", "password": PASSWORD}).status_code == 201
        page = admin.get("/administration", headers=HTML)
        assert "the clinic" in page.text and 'value="nobody-yet"' in page.text
        assert admin.put("/v1/users/Linus/provider", json={"subject": None}).status_code == 204
        assert status(visitor) == 401 and signs_in(visitor, double).status_code == 403


def test_nobody_gets_another_persons_account_by_name(service: Service, double: Double, visitor: httpx.Client) -> None:
    with service.client() as admin:
        assert admin.post("/v1/users", json={"name": "Vera", "password": PASSWORD}).status_code == 201
        double.groups, double.sub, double.claims = ["stim-readers"], "not-vera", {"name": "vera"}
        answer = signs_in(visitor, double)
        assert answer.status_code == 200 and "vera (2)" in answer.text
        assert visitor.post("/v1/sessions", json={"name": "vera (2)", "password": ""}).status_code == 401


def test_removed_here_wins(service: Service, double: Double, visitor: httpx.Client) -> None:
    double.groups, double.sub, double.claims = ["stim-clinicians"], "removed", {"name": "Rosa"}
    assert signs_in(visitor, double).status_code == 200
    with service.client() as admin:
        assert admin.delete("/v1/users/Rosa").status_code == 204
        assert status(visitor) == 401
        assert signs_in(visitor, double).status_code == 401 and why(service) == "removed"
        double.groups = []
        assert signs_in(visitor, double).status_code == 401
        assert sum(user["name"].startswith("Rosa") for user in admin.get("/v1/users").json()) == 1


@pytest.mark.parametrize(("alg", "key"), [("RS256", hostile_provider.RSA), ("ES256", EC), ("EdDSA", ED)])
def test_each_signature_that_is_allowed(double: Double, visitor: httpx.Client, alg: str, key: Any) -> None:
    double.alg, double.key, double.groups, double.sub = alg, key, ["stim-readers"], f"by {alg}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert signs_in(visitor, double).status_code == 200


def test_a_new_key_is_learned(service: Service, double: Double, visitor: httpx.Client) -> None:
    double.groups, double.sub = ["stim-readers"], "rotated"
    assert signs_in(visitor, double).status_code == 200
    double.key, double.kid = STRANGER, "k2"
    assert signs_in(visitor, double).status_code == 401, "not asked for again and again"
    asked = double.asked.count("/jwks")
    service.context.provider._keys = (service.context.clock.monotonic_s() - 31, service.context.provider._keys[1])
    assert signs_in(visitor, double).status_code == 200 and double.asked.count("/jwks") == asked + 1


# ---- what is not believed


def claim(**claims: Any) -> Callable[[Double], None]:
    return lambda double: double.claims.update(claims)


def set_to(**what: Any) -> Callable[[Double], None]:
    return lambda double: vars(double).update(what)


def answers(path: str, status: int, body: Any, **head: str) -> Callable[[Double], None]:
    return lambda double: double.answers.update({path: lambda request: request.say(status, body, **head)})


FAR = 4_000_000_000
NONSENSE = {"kty": "RSA", "kid": "k1", "n": "!" * 342, "e": "?"}
HOSTILE: dict[str, tuple[Callable[[Double], Any], str]] = {
    "another issuer": (claim(iss="https://elsewhere.example"), "iss"),
    "issuer with a slash": (lambda d: d.claims.update(iss=d.issuer + "/"), "iss"),
    "another client's": (claim(aud="another client"), "aud"),
    "several clients', not ours": (claim(aud=["a", "b"], azp="a"), "aud"),
    "several clients', no azp": (claim(aud=[CLIENT, "b"]), "azp"),
    "another's azp": (claim(azp="another client"), "azp"),
    "no aud": (claim(aud=None), "aud"),
    "expired": (lambda d: d.claims.update(exp=int(time.time()) - 120), "exp"),
    "no exp": (claim(exp=None), "exp"),
    "exp is no number": (claim(exp="4000000000"), "exp"),
    "exp is true": (claim(exp=True), "exp"),
    "exp without end": (claim(exp=10**400), "exp"),
    "issued tomorrow": (lambda d: d.claims.update(iat=int(time.time()) + 86400), "iat"),
    "issued long ago": (lambda d: d.claims.update(iat=int(time.time()) - 86400), "iat"),
    "no iat": (claim(iat=None), "iat"),
    "not yet": (claim(nbf=FAR), "nbf"),
    "another nonce": (claim(nonce="0" * 64), "nonce"),
    "no nonce": (claim(nonce=None), "nonce"),
    "no subject": (claim(sub=None), "sub"),
    "empty subject": (claim(sub=""), "sub"),
    "subject is a number": (claim(sub=7), "sub"),
    "long subject": (claim(sub="x" * 256), "sub"),
    "signed in yesterday": (lambda d: d.claims.update(auth_time=int(time.time()) - 86400), "auth_time"),
    "alg none": (set_to(alg="none"), "signed with none"),
    "HS256 with the public key": (set_to(alg="HS256"), "signed with HS256"),
    "RS512": (set_to(alg="RS512"), "signed with RS512"),
    "a stranger's key": (lambda d: setattr(d, "signed", stranger), "signature"),
    "a key of another kind": (lambda d: setattr(d, "signed", of_another_kind), "key"),
    "changed after it was signed": (lambda d: setattr(d, "signed", changed), "signature"),
    "no token": (set_to(signed=lambda _claims: None), "no id_token"),
    "no signature": (set_to(signed=lambda claims: encoded(claims)), "signature"),
    "claims are a list": (lambda d: setattr(d, "token", lambda _asked: Double.signed(d, ["sub"])), "no claims"),  # pyright: ignore[reportArgumentType]
    "an answer without end": (answers("/token", 200, b"[" * 300_000), "too long"),
    "brackets without end": (answers("/token", 200, b"[" * 200_000), "no JSON"),
    "no JSON": (answers("/token", 200, b"<html>"), "no JSON"),
    "sent elsewhere": (answers("/token", 302, b"{}", Location="http://127.0.0.1:9/"), "answers 302"),
    "keys are no list": (answers("/jwks", 200, {"keys": "none"}), "no keys"),
    "keys are nothing": (answers("/jwks", 200, {"keys": [1, {}, {"kty": "RSA", "n": "x" * 9000}]}), "key is not"),
    "key is nonsense": (answers("/jwks", 200, {"keys": [NONSENSE]}), "signature"),
}  # fmt: skip


def stranger(claims: dict[str, Any]) -> str:
    other = Double()
    other.key = STRANGER
    return other.signed(claims)


def of_another_kind(claims: dict[str, Any]) -> str:
    other = Double()
    other.key, other.alg = EC, "ES256"
    return other.signed(claims)


def changed(claims: dict[str, Any]) -> str:
    head, _, mark = Double().signed(claims).split(".")
    return f"{head}.{encoded(claims | {'sub': 'by-group'})}.{mark}"


@pytest.mark.parametrize("how", HOSTILE)
def test_what_does_not_hold_signs_nobody_in(service: Service, double: Double, visitor: httpx.Client, how: str) -> None:
    double.groups, double.sub = ["stim-clinicians"], f"hostile {how}"[:60]
    deceive, words = HOSTILE[how]
    before = service.sql("SELECT count(*) FROM identities")
    deceive(double)
    answer = signs_in(visitor, double)
    assert answer.status_code == 401 and "not accepted" in answer.text
    assert words in why(service), why(service)
    assert not {name for name in visitor.cookies if "session" in name} and status(visitor) == 401
    assert service.sql("SELECT count(*) FROM identities") == before


# ---- what a browser brings back


def test_an_answer_counts_once_and_for_who_began_it(service: Service, double: Double, visitor: httpx.Client) -> None:
    double.groups, double.sub = ["stim-readers"], "once"
    given = double.code_for(begun(visitor))
    cookies = dict(visitor.cookies)
    with service.client(token=None, auth=None, headers=HTML) as other:
        assert back(other, given).status_code == 401, "another visitor, led to the attacker's account"
        begun(other)
        assert back(other, given).status_code == 401 and why(service) == "another state"
    assert back(visitor, given).status_code == 200
    visitor.cookies.clear()
    visitor.cookies.update(cookies)
    assert back(visitor, given).status_code == 401 and why(service) == "used before"
    service.context.provider._used.clear()  # as after a restart: then the code itself is used
    visitor.cookies.clear()
    visitor.cookies.update(cookies)
    assert back(visitor, given).status_code == 401 and "invalid_grant" in why(service)


def test_an_old_answer_and_a_changed_cookie(
    service: Service, double: Double, visitor: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = double.code_for(begun(visitor))
    (name,) = [name for name in visitor.cookies if "sign_in" in name]
    text, before = visitor.cookies[name], service.context.store.all(AuditEntry.seq)
    for wrong in ("", ".", "x" + text, text[:-1] + ("0" if text[-1] != "0" else "1"), encoded({"id": "x"}) + ".0"):
        assert visitor.get("/sign-in/callback", params=given, headers={"Cookie": f"{name}={wrong}"}).status_code == 401
    assert service.context.store.all(AuditEntry.seq) == before, "any page can make a browser ask that"
    forget(service)
    monkeypatch.setattr(provider, "FLOW_S", -1.0)
    visitor.cookies.clear()
    visitor.cookies.set(name, text)
    assert back(visitor, given).status_code == 401 and why(service) == "begun too long ago"


def test_an_answer_of_another_provider(service: Service, double: Double, visitor: httpx.Client) -> None:
    given = double.code_for(begun(visitor))
    assert back(visitor, given | {"iss": "https://elsewhere.example"}).status_code == 401
    assert why(service) == "an answer of another provider"
    double.about = {"authorization_response_iss_parameter_supported": True}
    forget(service)
    assert signs_in(visitor, double).status_code == 401 and why(service) == "an answer of another provider"


def test_who_says_no_is_heard(service: Service, double: Double, visitor: httpx.Client) -> None:
    given = double.code_for(begun(visitor))
    denied = {"state": given["state"], "error": "access_denied", "error_description": "<script>alert(1)</script>"}
    answer = back(visitor, denied)
    assert answer.status_code == 401 and "<script>alert" not in answer.text
    assert why(service) == "the provider says access_denied"


@pytest.mark.parametrize("away", ["https://elsewhere.example/", "//elsewhere.example", "/\\elsewhere", "/a\r\nX: y"])
def test_nobody_is_led_elsewhere(double: Double, visitor: httpx.Client, away: str) -> None:
    double.groups, double.sub = ["stim-readers"], "led"
    answer = signs_in(visitor, double, away)
    assert answer.headers["refresh"] == "0; url=/" and "elsewhere" not in answer.text


def test_answers_are_held_to_a_pace(service: Service, double: Double, visitor: httpx.Client) -> None:
    clocks = service.context.guesses._callbacks.clock
    standing_still(service)
    try:
        wrong = {"code": "x", "state": "y"}
        for _ in range(7):  # led here by any page: it keeps nobody out
            assert back(visitor, wrong).status_code == 401
        codes = [(begun(visitor), back(visitor, wrong).status_code)[1] for _ in range(7)]
        assert codes == [401] * 5 + [429] * 2
        with service.client() as admin:
            assert admin.post("/v1/stop").status_code == 200, "a stop waits for none of that"
    finally:
        for pace in vars(service.context.guesses).values():
            if hasattr(pace, "wait_s"):
                pace.clock = clocks


# ---- once more: to confirm, to unlock


def test_signing_in_once_more_confirms_and_unlocks(service: Service, double: Double, visitor: httpx.Client) -> None:
    double.groups, double.sub, double.claims = ["stim-clinicians"], "again", {"name": "Noor"}
    assert signs_in(visitor, double).status_code == 200
    csrf = re.search(r'name="csrf" value="([^"]+)"', visitor.get("/").text)
    head = {"X-CSRF-Token": csrf[1] if csrf else ""}
    with service.client() as admin:
        admin.post("/v1/rearm")
        admin.post("/v1/participants", json={"code": "P9"})
        model = run_test(admin, "P9")
        version = admin.get(model["model_url"]).headers["etag"]
    approve = {"json": {"reason": "good"}, "headers": head | {"If-Match": version, "Accept": "application/json"}}
    assert visitor.post(f"{model['model_url']}/approve", **approve).json()["type"] == "/problems/confirm-password"
    assert "sign-in/provider?again=1" in visitor.get(f"/models/{model['model_id']}").text
    double.claims = {"name": "Noor", "auth_time": None}
    assert signs_in(visitor, double, again="1").status_code == 401 and "auth_time" in why(service)
    double.claims, double.sub = {"name": "Somebody Else"}, "somebody-else"
    assert signs_in(visitor, double, again="1").status_code == 403 and why(service) == "another-person"
    assert visitor.post(f"{model['model_url']}/approve", **approve).status_code == 403
    double.claims, double.sub = {"name": "Noor"}, "again"
    assert signs_in(visitor, double, again="1").status_code == 200
    assert visitor.post(f"{model['model_url']}/approve", **approve).json()["decided_by"] == "Noor"
    assert visitor.post("/v1/sessions/lock", headers=head).status_code == 204
    assert status(visitor) == 401 and "sign-in/provider?again=1" in visitor.get("/locked").text
    assert signs_in(visitor, double, again="1").status_code == 200 and status(visitor) == 200


# ---- a provider that is not there


@pytest.mark.parametrize(
    "trouble",
    [
        answers("/.well-known/openid-configuration", 500, {}),
        answers("/.well-known/openid-configuration", 404, {}),
        answers("/.well-known/openid-configuration", 302, b"", Location="http://127.0.0.1:9/"),
        answers("/.well-known/openid-configuration", 200, b"x" * 300_000),
        set_to(about={"issuer": "https://elsewhere.example"}),
        set_to(about={"token_endpoint": "http://elsewhere.example/token"}),
        set_to(about={"jwks_uri": "file:///etc/passwd"}),
        set_to(about={"authorization_endpoint": "javascript:alert(1)"}),
    ],
)
def test_a_provider_that_fails_leads_nowhere(
    double: Double, visitor: httpx.Client, trouble: Callable[[Double], None]
) -> None:
    trouble(double)
    answer = visitor.get("/sign-in/provider")
    assert answer.status_code == 503 and "does not answer" in answer.text and 'name="password"' in answer.text


def test_a_slow_provider_keeps_nothing_waiting(
    service: Service, double: Double, visitor: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it is silent people sign in, a test is stopped, and no database connection is held."""
    monkeypatch.setattr(provider, "ANSWER_S", 0.5)
    double.groups, double.sub = ["stim-readers"], "slow"
    given = double.code_for(begun(visitor))

    def says_nothing(request: Any) -> None:
        with service.client() as admin, service.client(token=None, auth=None) as other:
            held = service.context.store.engine.pool.checkedout()
            seen.put((admin.post("/v1/stop").status_code, other.get("/").status_code, held))
        answered.wait(PATIENCE_S)
        request.close_connection = True

    seen, answered = queue.Queue[Any](), threading.Event()
    double.answers["/token"] = says_nothing
    answer = back(visitor, given)
    answered.set()
    assert answer.status_code == 503 and seen.get(timeout=PATIENCE_S) == (200, 200, 0)


def test_the_machine_without_a_network_works(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, STUB, **settings_for("http://127.0.0.1:9")):
        with service.client(token=None, auth=None, headers=HTML, follow_redirects=False) as visitor:
            assert "the clinic" in visitor.get("/sign-in").text
            assert visitor.get("/sign-in/provider").status_code == 503
        with service.client() as admin:
            admin.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
            assert admin.post("/v1/sessions", json={"name": "Ada", "password": PASSWORD}).status_code == 201
            assert admin.post("/v1/stop").status_code == 200


def test_without_a_provider_there_is_no_button(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, STUB):
        with service.client(token=None, auth=None, headers=HTML) as visitor:
            assert "/sign-in/provider" not in visitor.get("/sign-in").text
            assert visitor.get("/sign-in/provider").status_code == 404
            assert visitor.get("/sign-in/callback").status_code == 404
        with service.client() as admin:
            admin.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
            assert admin.put("/v1/users/Ada/provider", json={"subject": "x"}).status_code == 409


# ---- settings


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"oidc_issuer": "http://login.example.org"}, "STIMRIG_OIDC_ISSUER: .*https://"),
        ({"oidc_issuer": "login.example.org"}, "STIMRIG_OIDC_ISSUER: it is no address"),
        ({"oidc_issuer": "https://me@login.example.org"}, "STIMRIG_OIDC_ISSUER: it is no address"),
        ({"oidc_public_url": None}, "STIMRIG_OIDC_PUBLIC_URL: the issuer"),
        ({"oidc_public_url": "http://rig.example.org"}, "STIMRIG_OIDC_PUBLIC_URL: .*https://"),
        ({"oidc_client_id": ""}, "STIMRIG_OIDC_CLIENT_ID: the issuer"),
        ({"oidc_roles": "clinicians"}, "STIMRIG_OIDC_ROLES: clinicians is no pair"),
    ],
)
def test_a_wrong_setting_is_one_line(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        Settings(**settings_for("https://login.example.org") | wrong)


def test_a_secret_stands_in_a_file_and_a_role_is_one_of_ours(tmp_path: Path, short_dir: Path) -> None:
    more = settings_for("http://127.0.0.1:9")
    (tmp_path / "secret").write_text("from a file\n")
    found = Settings(**more | {"oidc_client_secret": None, "oidc_client_secret_file": tmp_path / "secret"})
    assert found.oidc_secret() == "from a file" and "from a file" not in repr(found)
    with pytest.raises(SettingsError, match="secret"):
        Settings(**more | {"oidc_client_secret_file": tmp_path / "nowhere"}).oidc_secret()
    with pytest.raises(SettingsError, match="owner is no role"):
        list(run_service(tmp_path, short_dir, STUB, **more | {"oidc_roles": "a=owner"}))


# ---- a real provider, and a centre


@pytest.fixture
def real() -> Iterator[str]:
    """`oidc-provider-mock`: authlib's server, whose code is not ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import oidc_provider_mock as mock

        person = mock.User(sub="ada@clinic", claims={"name": "Ada", "groups": ["stim-readers"]})
        with mock.run_server_in_thread(user_claims=[person]) as server:
            yield f"http://localhost:{server.server_port}"


def through_the_real_one(visitor: httpx.Client) -> httpx.Response:
    """As a person does it: the button, the provider's form, and what its answer leads to."""
    address = begun(visitor, "/participants")
    with httpx.Client(timeout=PATIENCE_S, verify=NO_TLS) as there:
        assert there.get(address).status_code == 200
        answer = there.post(address, data={"sub": "ada@clinic"})
    leads = urlsplit(answer.headers["location"])
    assert f"{leads.scheme}://{leads.netloc}" == PUBLIC
    return visitor.get(f"{leads.path}?{leads.query}")


def test_through_a_real_provider(tmp_path: Path, short_dir: Path, real: str) -> None:
    for service in run_service(tmp_path, short_dir, STUB, **settings_for(real)):
        with service.client(token=None, auth=None, headers=HTML, follow_redirects=False) as visitor:
            answer = through_the_real_one(visitor)
            assert answer.status_code == 200 and answer.headers["refresh"] == "0; url=/participants", answer.text
            assert status(visitor) == 200 and status(visitor, "/v1/participants") == 403


def test_a_centre_through_a_real_provider(tmp_path: Path, real: str) -> None:
    for centre in run_centre(tmp_path, **settings_for(real)):
        with httpx.Client(base_url=centre.url, headers=HTML, timeout=PATIENCE_S, verify=NO_TLS) as visitor:
            answer = through_the_real_one(visitor)
            assert answer.status_code == 200, answer.text
            assert visitor.get("/participants").status_code == 200
            assert [user["name"] for user in centre.app.state.context.people.documents()] == ["Ada"]
            centre.clock.later_s = 7200.0
            late = through_the_real_one(visitor)
            assert late.status_code == 401, "with a clock that is wrong nobody is signed in"


def test_a_browser_goes_there_and_comes_back(tmp_path: Path, short_dir: Path, browser: Any, real: str) -> None:
    """Another site leads back here: a browser sends no strict cookie with that, and stays signed in all the same."""
    for service in run_service(tmp_path, short_dir, STUB, **settings_for(real)):
        service.context.provider.redirect_uri = f"{service.url}/sign-in/callback"  # 127.0.0.1; the provider: localhost
        tab = browser.new_page()
        tab.set_default_timeout(PATIENCE_S * 1000)
        tab.goto(f"{service.url}/sign-in?next=/docs")
        tab.click("#by-provider")
        assert tab.url.startswith(real)
        tab.locator("button", has_text="ada@clinic").first.click()
        tab.wait_for_url(f"{service.url}/docs")
        tab.goto(f"{service.url}/")
        assert tab.locator("text=Ada").count() and not tab.locator("#by-provider").count()
        tab.close()

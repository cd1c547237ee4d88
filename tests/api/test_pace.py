"""Guesses are slowed down, and lock nobody out but who makes them."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import islice
from typing import Any

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.accounts import MOST_STRANGERS, Passwords
from stimrig.api.people.pace import (
    FORGOTTEN_S,
    FREE_FOR_A_NAME,
    FREE_TRIES,
    LONGEST_WAIT_S,
    Guesses,
    password_keys,
    place_of,
)
from stimrig.api.store.tables import User
from tests.api.conftest import PASSWORD, TOKEN, Service, SetClock
from tests.api.test_people import standing_still

OWN, ELSEWHERE = "10.0.0.1", "10.9.9.9"
KEY = ("token", "a")


def test_waits_double_up_to_five_minutes_and_end() -> None:
    clock = SetClock()
    guesses, waits = Guesses(clock), []
    for _ in range(FREE_TRIES + 12):
        guesses.count(KEY)
        waits.append(guesses.wait_s(KEY))
        clock.now_s += waits[-1]
    assert waits[: FREE_TRIES + 4] == [0] * (FREE_TRIES - 1) + [1, 2, 4, 8, 16]
    assert waits[-1] == max(waits) == LONGEST_WAIT_S
    clock.now_s += FORGOTTEN_S + 1
    guesses.count(KEY)
    assert guesses.wait_s(KEY) == 0, "after an hour it starts anew"
    assert FREE_TRIES / FORGOTTEN_S <= 1 / LONGEST_WAIT_S, "who waits for that is no faster than who tries on"


def test_no_flood_of_keys_forgets_one_that_counts() -> None:
    clock = SetClock()
    guesses = Guesses(clock, most_keys=100)
    for _ in range(12):
        guesses.count(KEY)
    for number in range(20_000):
        guesses.count(("token", f"n{number}"))
        clock.now_s += 0.001
    assert guesses.wait_s(KEY) > 80 and len(guesses._counts["token"]) <= 101, "kept, in memory that does not grow"
    assert guesses.wait_s(("token", "new")) > 200, "newcomers share one count while there is no room"
    assert guesses.wait_s(("place", "new")) == 0, "but for those of another kind"
    clock.now_s += FORGOTTEN_S + 1
    assert guesses.wait_s(("token", "new")) == len(guesses._counts["token"]) == 0, "room is made of what has run out"


def test_a_wall_clock_that_is_set_back_ends_no_wait() -> None:
    clock = Clock()
    clock.unix_s = lambda: 0.0
    guesses = Guesses(clock)
    for _ in range(8):
        guesses.count(KEY)
    assert 6 < guesses.wait_s(KEY) <= 8


def test_one_right_sign_in_gives_no_new_guesses_to_its_place() -> None:
    guesses = Guesses(SetClock())
    with pytest.raises(ApiError) as caught:
        for number in range(10):
            guesses.admit(*password_keys(f"n{number}", ELSEWHERE, known=False))
            guesses.admit(*(own := password_keys("Eve", ELSEWHERE, known=False)))
            guesses.was_right(*own)
    assert caught.value.status == 429 and int(caught.value.headers["Retry-After"]) > 0


PLACES = {
    "10.0.0.1": "10.0.0.1", "::ffff:10.0.0.1": "10.0.0.1", "::1": "::", "2001:db8:1:2:3:4:5:6": "2001:db8:1:2::",
    "2001:db8:1:2:ffff::1": "2001:db8:1:2::", "": "", "testclient": "testclient",
}  # fmt: skip


@pytest.mark.parametrize(("address", "place"), PLACES.items())
def test_a_place_is_what_one_customer_gets(address: str, place: str) -> None:
    assert place_of(address) == place


# ---- over HTTP ----------------------------------------------------------------------------------------------


def sign_in(service: Service, password: str, address: str, name: str = "Ada") -> int:
    with service.client(token=None, headers={"X-Forwarded-For": address}) as http:
        return http.post("/v1/sessions", json={"name": name, "password": password}).status_code


def test_the_owner_signs_in_and_confirms_whatever_others_try(service: Service, client: httpx.Client) -> None:
    clock = standing_still(service)
    client.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
    ada = service.client(token=None, headers={"X-Forwarded-For": OWN})
    ada.headers["X-CSRF-Token"] = ada.post("/v1/sessions", json={"name": "Ada", "password": PASSWORD}).json()["csrf"]
    for name in ("Ada", "Nobody"):  # a name that is nobody's is held back like one that is
        tries = [sign_in(service, f"guess {number}", f"10.{len(name)}.0.9", name) for number in range(7)]
        assert tries == [401] * 5 + [429] * 2
    answers = [sign_in(service, "guess", f"10.8.0.{number}") for number in range(FREE_FOR_A_NAME)]
    assert answers[-1] == 429, "from many places, too"
    assert ada.post("/v1/sessions/confirm", json={"password": PASSWORD}).status_code == 204
    assert sign_in(service, PASSWORD, OWN) == 201
    assert [sign_in(service, "slip", OWN) for _ in range(6)] == [401] * 5 + [429], "her own tries are counted"
    slips = [ada.post("/v1/sessions/confirm", json={"password": "slip"}).status_code for _ in range(6)]
    assert slips == [401] * 5 + [429]
    clock.now_s += LONGEST_WAIT_S
    assert sign_in(service, PASSWORD, OWN) == 201


def test_guesses_of_tokens_are_slowed_down_and_keep_no_controller_out(
    service: Service, client: httpx.Client, participant: str
) -> None:
    standing_still(service)
    drawn, path = service.token("ilc", "read-model"), f"/v1/participants/{participant}/models"

    def status(token: str, address: str) -> int:
        with service.client(token, headers={"X-Forwarded-For": address}) as http:
            return http.get(path).status_code

    assert [status(f"guess {number}", ELSEWHERE) for number in range(7)] == [401] * 5 + [429] * 2
    assert status("guess", OWN) == 401, "another place is not held back"
    assert status(drawn, ELSEWHERE) == 200, "nobody guesses a drawn token, and nobody keeps it out"
    assert status(TOKEN, ELSEWHERE) == 429, "one that a person chose could be guessed"
    assert status(TOKEN, OWN) == 200
    assert [status(f"guess {number}", OWN) for number in range(5)][-1] == 429
    assert status(TOKEN, OWN) == 200, "where it opened before, it goes on opening"
    with service.client(token=None, headers={"X-Forwarded-For": "10.0.0.7"}) as page:
        answers = [page.post("/v1/sessions", data={"token": f"guess {number}"}).status_code for number in range(6)]
        assert answers == [401] * 5 + [429], "the page's door is held to the same pace"
        refused = page.post("/v1/sessions", data={"token": "guess"}, headers={"Accept": "text/html"})
        assert int(refused.headers["retry-after"]) >= 1 and "Try again in" in refused.text
        assert page.get(path, headers={"Authorization": "Bearer guess"}).status_code == 429
        assert page.post("/v1/stop", headers={"Authorization": f"Bearer {drawn}"}).status_code == 200


def test_a_known_place_is_kept_and_forgotten_with_the_password(service: Service, client: httpx.Client) -> None:
    client.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
    old = [f"10.4.0.{number}" for number in range(20)]
    service.change(User, "Ada", places=old)
    for _ in range(2):
        assert sign_in(service, PASSWORD, OWN) == 201
    assert service.context.store.get(User, "Ada").places == [OWN, *old[:-1]], "so many are kept, not more"
    client.put("/v1/users/Ada/password", json={"password": "another passphrase"})
    assert service.context.store.get(User, "Ada").places == []


def test_guesses_fill_no_thread_that_others_need() -> None:
    """So many strangers wait, and the next ones are refused. A known person is checked at once."""
    passwords, gate = Passwords(), threading.Event()
    hasher: Any = passwords.hasher

    class Slow:
        def verify(self, hashed: str, password: str) -> bool:
            if password == "guess":
                gate.wait(30)
            return hasher.verify(hashed, password)

    def check(hashed: str, password: str, known: bool) -> bool | int:
        try:
            with passwords.room(known):
                return passwords.verify(hashed, password, known)
        except ApiError as error:
            return error.status

    hashed = passwords.hash("right")
    passwords.hasher = Slow()
    with ThreadPoolExecutor(50) as threads:
        guesses = [threads.submit(check, hashed, "guess", False) for _ in range(50)]
        refused = islice(as_completed(guesses, 30), 50 - MOST_STRANGERS)
        assert {guess.result() for guess in refused} == {429}
        assert check(hashed, "right", True) is True
        gate.set()
    assert check(hashed, "right", False) is True

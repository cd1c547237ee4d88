"""Guesses are slowed down, and lock nobody out but who makes them."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.accounts import MOST_STRANGERS, Passwords
from stimrig.api.people.pace import FORGOTTEN_S, FREE_FOR_A_NAME, FREE_TRIES, LONGEST_WAIT_S, Guesses, Pace, place_of
from tests.api.conftest import TOKEN, Service, SetClock
from tests.api.test_people import PASSWORD, standing_still

OWN, ELSEWHERE = "10.0.0.1", "10.9.9.9"


def held(ask: Callable[..., object], *given: Any, **more: Any) -> int:
    """0 where it is admitted, else the wait that is asked for, s."""
    try:
        ask(*given, **more)
    except ApiError as problem:
        assert problem.status == 429
        return int(problem.headers["Retry-After"])
    return 0


def test_waits_double_up_to_five_minutes_and_end() -> None:
    clock = SetClock()
    pace = Pace(clock)
    waits = []
    for _ in range(FREE_TRIES + 12):
        pace.count("a")
        waits.append(pace.wait_s("a"))
        clock.now_s += waits[-1]
    assert waits[:FREE_TRIES] == [0] * (FREE_TRIES - 1) + [1]
    assert waits[FREE_TRIES:][:4] == [2, 4, 8, 16] and waits[-1] == max(waits) == LONGEST_WAIT_S
    clock.now_s += FORGOTTEN_S + 1
    pace.count("a")
    assert pace.wait_s("a") == 0, "after an hour it starts anew"
    assert FREE_TRIES / FORGOTTEN_S <= 1 / LONGEST_WAIT_S, "who waits for that is no faster than who tries on"


def test_no_flood_of_keys_forgets_one_that_counts() -> None:
    clock = SetClock()
    pace = Pace(clock, most_keys=100)
    for _ in range(12):
        pace.count("guessed")
    for number in range(20_000):
        pace.count(f"n{number}")
        clock.now_s += 0.001
    assert pace.wait_s("guessed") > 80 and len(pace) <= 101, "what counts is kept, in memory that does not grow"
    assert pace.wait_s("new") > 200, "who comes new shares one pace while there is no room"
    clock.now_s += FORGOTTEN_S + 1
    assert pace.wait_s("new") == 0 and len(pace) == 0, "room is made of what has run out"


def test_a_wall_clock_that_is_set_back_ends_no_wait() -> None:
    clock = Clock()
    clock.unix_s = lambda: 0.0
    pace = Pace(clock)
    for _ in range(8):
        pace.count("a")
    assert 6 < pace.wait_s("a") <= 8


@pytest.mark.parametrize("name", ["Ada", "Nobody"])
def test_a_name_that_is_nobodys_is_held_back_like_one_that_is(name: str) -> None:
    guesses = Guesses(SetClock())
    assert [held(guesses.password, name, OWN, known=False) for _ in range(8)] == [0] * 5 + [2] * 3


def test_one_right_sign_in_gives_no_new_guesses_to_its_place() -> None:
    guesses = Guesses(SetClock())
    for round_ in range(4):
        for number in range(2):
            held(guesses.password, f"n{round_}-{number}", ELSEWHERE, known=False)
        if held(guesses.password, "Eve", ELSEWHERE, known=False) == 0:
            guesses.password_was_right("Eve", ELSEWHERE, known=False)
    assert held(guesses.password, "next", ELSEWHERE, known=False) > 0


PLACES = {
    "10.0.0.1": "10.0.0.1", "::ffff:10.0.0.1": "10.0.0.1", "::1": "::", "2001:db8:1:2:3:4:5:6": "2001:db8:1:2::",
    "2001:db8:1:2:ffff::1": "2001:db8:1:2::", "": "", "testclient": "testclient",
}  # fmt: skip


@pytest.mark.parametrize(("address", "place"), PLACES.items())
def test_a_place_is_what_one_customer_gets(address: str, place: str) -> None:
    assert place_of(address) == place


# ---- over HTTP ----------------------------------------------------------------------------------------------


def sign_in(service: Service, password: str, address: str) -> int:
    with service.client(token=None, headers={"X-Forwarded-For": address}) as http:
        return http.post("/v1/sessions", json={"name": "Ada", "password": password}).status_code


def test_the_owner_signs_in_and_confirms_whatever_others_try(service: Service, client: httpx.Client) -> None:
    clock = standing_still(service)
    client.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
    ada = service.client(token=None, headers={"X-Forwarded-For": OWN})
    ada.headers["X-CSRF-Token"] = ada.post("/v1/sessions", json={"name": "Ada", "password": PASSWORD}).json()["csrf"]
    assert [sign_in(service, f"guess {number}", ELSEWHERE) for number in range(7)] == [401] * 5 + [429] * 2
    answers = [sign_in(service, "guess", f"10.3.0.{number}") for number in range(FREE_FOR_A_NAME)]
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

    def asked(token: str, address: str) -> int:
        with service.client(token, headers={"X-Forwarded-For": address}) as http:
            return http.get(path).status_code

    assert [asked(f"guess {number}", ELSEWHERE) for number in range(7)] == [401] * 5 + [429] * 2
    assert asked("guess", OWN) == 401, "another place is not held back"
    assert asked(drawn, ELSEWHERE) == 200, "nobody guesses a drawn token, and nobody keeps it out"
    assert asked(TOKEN, ELSEWHERE) == 429, "one that a person chose could be guessed"
    assert asked(TOKEN, OWN) == 200
    assert [asked(f"guess {number}", OWN) for number in range(5)][-1] == 429
    assert asked(TOKEN, OWN) == 200, "where it opened before, it goes on opening"
    with service.client(token=None, headers={"X-Forwarded-For": "10.0.0.7"}) as page:
        answers = [page.post("/v1/sessions", data={"token": f"guess {number}"}).status_code for number in range(6)]
        assert answers == [401] * 5 + [429], "the page's door is held to the same pace"
        told = page.post("/v1/sessions", data={"token": "guess"}, headers={"Accept": "text/html"})
        assert told.status_code == 429 and int(told.headers["retry-after"]) >= 1 and "Try again in" in told.text
        assert page.get(path, headers={"Authorization": "Bearer guess"}).status_code == 429
        assert page.post("/v1/stop", headers={"Authorization": f"Bearer {drawn}"}).status_code == 200


def test_a_known_place_is_remembered_over_a_restart_and_forgotten_with_the_password(
    service: Service, client: httpx.Client
) -> None:
    people = service.context.people
    client.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
    assert people._look_up("Ada", OWN)[1] is False
    for number in range(25):
        people._remember("Ada", f"10.4.0.{number}")
    assert sign_in(service, PASSWORD, OWN) == 201 and people._look_up("Ada", OWN)[1] is True
    assert people._look_up("Ada", "10.4.0.1")[1] is False, "so many places are kept, not more"
    client.put("/v1/users/Ada/password", json={"password": "another passphrase"})
    assert people._look_up("Ada", OWN)[1] is False


def test_guesses_fill_no_thread_that_others_need() -> None:
    """Strangers wait in a lane of their own, and are refused when it is full. A known person is checked at once."""
    passwords, gate = Passwords(), threading.Event()
    slow: Any = passwords.hasher

    class Slow:
        def verify(self, hashed: str, password: str) -> bool:
            if password == "guess":
                gate.wait(30)
            return slow.verify(hashed, password)

    async def checked(hashed: str, password: str, known: bool) -> bool:
        with passwords.room(known) as lane:
            return await passwords.verify(lane, hashed, password)

    async def attack() -> None:
        hashed = await passwords.hash("right")
        passwords.hasher = Slow()  # pyright: ignore[reportAttributeAccessIssue]
        guesses = [asyncio.create_task(checked(hashed, "guess", False)) for _ in range(50)]
        await asyncio.sleep(0)
        refused = [task.exception() for task in guesses if task.done()]
        assert len(refused) == 50 - MOST_STRANGERS
        assert {problem.status for problem in refused if isinstance(problem, ApiError)} == {429}
        assert await checked(hashed, "right", True)
        assert await asyncio.to_thread(lambda: "a thread for others") == "a thread for others"
        gate.set()
        assert await asyncio.gather(*guesses, return_exceptions=True) and await checked(hashed, "right", False)

    asyncio.run(attack())
    passwords.close()

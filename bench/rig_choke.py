"""A stop while others choke the rig and the service: how long until it is answered?

    python -m bench.rig_choke [--stops N] [--previews N] [--half-open N]

Emulator, rig and service as processes, at the speed of the world. While a test plays, so many clients ask for the
longest preview again and again, and so many connections to the service's port and to the rig's two sockets have sent
half a request and are held. Each stop falls at a random moment. Printed for each case: time to the answer at
`POST /v1/stop`, and, by the emulator's own record, to the last pulse felt.
"""

from __future__ import annotations

import contextlib
import json
import random
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np

from bench.common import http_client, parser, services, spread
from stimrig.api.cli.launcher import Services
from stimrig.rig.messages import stop_socket
from tests.harness.processes import RigClient, control

HOLD = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.2}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 30.0, "off_s": 0.0, "repeats": 1}},
]
LONGEST = [{"name": "x", "sequence": "multilevel", "settings": {"duration_s": 75.0, "min_hold_s": 0.02}}] * 4
MEASURES = ("to the answer", "to the last pulse")


class Crowd:
    """Clients that ask for previews until they are told to end; counts the answers by status."""

    def __init__(self, url: str, number: int) -> None:
        self.url, self.statuses, self.ended = url, {}, threading.Event()
        self.threads = [threading.Thread(target=self._ask, daemon=True) for _ in range(number)]

    def __enter__(self) -> Crowd:
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        for thread in self.threads:
            thread.join()

    def _ask(self) -> None:
        body = {"participant": "P01", "segments": LONGEST}
        with http_client(self.url, 30) as http:
            while not self.ended.is_set():
                try:
                    status: Any = http.post("/v1/preview", json=body).status_code
                except httpx.HTTPError as error:
                    status = type(error).__name__
                self.statuses[status] = self.statuses.get(status, 0) + 1


@contextlib.contextmanager
def half_open(services: Services, number: int) -> Iterator[None]:
    """Connections to port and sockets, held; half a request was sent on each. Those that are closed are opened anew."""
    ended = threading.Event()
    port = services.api.ready["port"]
    doors: list[tuple[int, Any, bytes]] = [(socket.AF_INET, ("127.0.0.1", port), b"POST /v1/stop HTTP/1.1\r\nHos")]
    paths = (services.socket, stop_socket(services.socket))
    doors += [(socket.AF_UNIX, str(path), b'{"kind": "stop", "id') for path in paths]

    def hold(family: int, address: Any, half: bytes) -> None:
        held: list[socket.socket] = []
        while not ended.is_set():
            with contextlib.suppress(OSError):
                held.append(socket.socket(family, socket.SOCK_STREAM))
                held[-1].settimeout(5)
                held[-1].connect(address)
                held[-1].sendall(half)
            if len(held) > number:
                held.pop(0).close()
                ended.wait(0.05)
        for connection in held:
            connection.close()

    threads = [threading.Thread(target=hold, args=door, daemon=True) for door in doors if number]
    for thread in threads:
        thread.start()
    if number:
        time.sleep(3.0)
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def one_stop(services: Services, http: httpx.Client) -> tuple[float, float]:
    """Milliseconds to the answer and to the last pulse felt."""
    while True:
        started = http.post("/v1/tests", json={"participant": "P01", "kind": "sequence", "segments": HOLD})
        if started.status_code == 202:
            break
        time.sleep(0.2)
    test = f"/v1/tests/{started.json()['id']}"
    time.sleep(2.0 + random.random() * 0.3)
    asked_s = time.monotonic()
    answer = http.post("/v1/stop", json={"reason": "bench"})
    answer_ms = 1e3 * (time.monotonic() - asked_s)
    assert answer.status_code == 200, answer.text
    assert services.emulator is not None
    pulses = control(services.emulator.ready["control"], {"cmd": "pulses", "since": 0})["pulses"]
    while not http.get(test).json()["done"]:
        time.sleep(0.1)
    reply = RigClient(services.socket).rearm("bench")
    assert reply["ok"], reply
    return answer_ms, 1e3 * (pulses[-1]["monotonic_s"] - asked_s) if pulses else float("nan")


def measure(stops: int, previews: int, connections: int) -> tuple[np.ndarray, dict[Any, int]]:
    """Each stop's times, shape (stops, 2), and how the previews were answered."""
    with services("--noise-seed", "7") as (running, _), http_client(running.url, 30) as http:
        assert http.post("/v1/participants", json={"code": "P01"}).status_code == 201
        with half_open(running, connections), Crowd(running.url, previews) as crowd:
            found = np.array([one_stop(running, http) for _ in range(stops)])
    return found, crowd.statuses


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--stops", type=int, default=50)
    made.add_argument("--previews", type=int, default=40)
    made.add_argument("--half-open", type=int, default=1200)
    options = made.parse_args()
    cases = [(0, 0), (options.previews, 0), (0, options.half_open), (options.previews, options.half_open)]
    for previews, connections in cases:
        found, statuses = measure(options.stops, previews, connections)
        print(f"{previews} previews at once, {connections} half-open connections at each door, {len(found)} stops")
        for name, values in zip(MEASURES, found.T, strict=True):
            figures = spread(values[np.isfinite(values)], 1.0)
            print(f"  {name}: " + ", ".join(f"{what} {ms:.0f} ms" for what, ms in figures.items()))
        if statuses:
            print(f"  previews answered: {json.dumps({str(key): n for key, n in sorted(statuses.items(), key=str)})}")


if __name__ == "__main__":
    main()

"""One connection to a service: requests, their errors, and the live channel."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator
from typing import Any, Self

import httpx
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from stimrig.api import decisions
from stimrig.api.client.errors import Unreachable, refused

MOST_OWN = 200
"""Entries of one's own that are told, the newest; of older ones one is told as of another's."""


class SendsVersions(httpx.Auth):
    """Sends with each decision the version of what it is made on: the one that was last seen, or that of now.

    A program that has read a participant, a model or the rig, and decides on it, is so refused (409) if that has
    changed meanwhile by anybody else. One that has not read it decides on what is there now.

    Parameters
    ----------
    headers : dict
        Sent with each request.
    """

    requires_response_body = False

    def __init__(self, headers: dict[str, str]) -> None:
        self._headers, self.seen, self.own = headers, dict[str, str](), list[str]()

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response, None]:
        """As httpx asks for it."""
        request.headers.update(self._headers)
        for document in [] if "if-match" in request.headers else self._documents(request):
            if document not in self.seen:
                looking = httpx.Request("GET", request.url.copy_with(path=document, query=None), headers=self._headers)
                found = yield looking
                self._keep(document, found)
                if found.status_code == httpx.codes.NOT_FOUND and document not in self.seen:
                    return  # there is nothing to decide on: that is the answer
            if tag := self.seen.get(document):
                request.headers["if-match"] = tag
                request.headers["trail-own"] = ", ".join(self.own[-MOST_OWN:])
                break
        answer = yield request
        self._keep(request.url.path, answer)

    def _documents(self, request: httpx.Request) -> list[str]:
        """Whose version may be sent with a request; none: it decides nothing.

        A test is begun on its participant. A controller's key cannot read that: its trials are planned with the model.
        """
        found = decisions.find(request.method, request.url.path)
        if found is None:
            return []
        decision, names = found
        if decision.path != "/v1/tests":
            return [decision.document.format(**names)]
        try:
            body = json.loads(request.read())
            person = decision.document.format(code=body["participant"])
        except (ValueError, KeyError, TypeError):  # the service says what is wrong with it
            return []
        return [person, f"{person}/model"]

    def _keep(self, path: str, answer: httpx.Response) -> None:
        if answer.request.method == "GET":
            self.seen.pop(path, None)
            if answer.status_code == httpx.codes.FORBIDDEN:
                self.seen[path] = ""  # a controller's key reads no participant
            if "etag" in answer.headers:  # of a calibration that waits to be stored with a 404, too
                self.seen[path] = answer.headers["etag"]
        elif answer.is_success and path == "/v1/stop":
            self._forget("/v1/rig")
        elif answer.is_success and (found := decisions.find(answer.request.method, path)):
            decision, names = found
            # of what the rig keeps there is another version now; the rest stays as seen, but for one's own entries
            self._forget(decision.document.format(**names) if decision.field in decisions.OF_RIG else path)
            self.own += [entry for entry in answer.headers.get("trail-entries", "").split(", ") if entry]

    def _forget(self, about: str) -> None:
        self.seen = {kept: tag for kept, tag in self.seen.items() if not kept.startswith(about)}


class Connection:
    """Requests to one service with one token. Use it in a `with` statement, or call `close`.

    Parameters
    ----------
    url : str
        Address of the service, e.g. "http://127.0.0.1:8000".
    token : str
        Sent with each request.
    timeout_s : float
        How long to wait for an answer.
    """

    def __init__(self, url: str, token: str = "", timeout_s: float = 60.0) -> None:
        self.url, self._headers = url.rstrip("/"), {"Authorization": f"Bearer {token}"} if token else {}
        try:
            self.http = httpx.Client(base_url=self.url, auth=SendsVersions(self._headers), timeout=timeout_s)
        except httpx.InvalidURL as error:
            raise self._unreachable(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.http.close()

    def request(self, method: str, path: str, **more: Any) -> httpx.Response:
        """Send a request, once. `more` goes to httpx: `json`, `params`, `content`, `headers`, `timeout`.

        The answer has a status of success, or 304. Raises Unreachable: there was no answer. Raises Refused: the answer
        is a problem; its class tells the status: `NotFound`, `Conflict`, `Invalid`, …
        """
        try:
            return _accepted(self.http.request(method, path, **more))
        except (httpx.RequestError, httpx.InvalidURL) as error:
            raise self._unreachable(error) from error

    def get(self, path: str, **more: Any) -> Any:
        """The JSON document at a path, as "/v1/rig"."""
        return self.request("GET", path, **more).json()

    def post(self, path: str, **more: Any) -> Any:
        """Send, and return the JSON document of the answer."""
        return self.request("POST", path, **more).json()

    def messages(self, path: str) -> Iterator[dict[str, Any]]:
        """JSON messages of a WebSocket until the service closes it. Raises Unreachable or Refused."""
        address = self.url.replace("http", "ws", 1) + path
        try:
            with connect(address, additional_headers=self._headers, open_timeout=self.http.timeout.connect) as socket:
                for text in socket:
                    message = json.loads(text)
                    if message["type"] == "problem":
                        raise refused(f"WS {path}", message["problem"]["status"], message["problem"])
                    yield message
        except (OSError, WebSocketException) as error:
            raise self._unreachable(error) from error

    def _unreachable(self, error: Exception) -> Unreachable:
        why = str(error) or type(error).__name__
        return Unreachable(self.url, "the service cannot be reached", f"{why}. Is `stimrig serve` running there?")


def _accepted(answer: httpx.Response) -> httpx.Response:
    """An answer that is read, if it is none of a problem. Raises Refused."""
    if answer.is_success or answer.status_code == httpx.codes.NOT_MODIFIED:
        return answer
    try:
        problem = answer.json()
    except ValueError:
        problem = None
    raise refused(f"{answer.request.method} {answer.request.url.path}", answer.status_code, problem, answer.text)

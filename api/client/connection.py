"""One connection to a service: requests with the version of what they decide on, their errors, and the live channel."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Self

import httpx
from pydantic_core import to_jsonable_python
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from stimrig.api.client.decisions import document_of
from stimrig.api.client.errors import Unreachable, refused


class Connection:
    """Requests to one service with one token. Use it in a `with` statement, or call `close`.

    A decision is sent with the `ETag` that was last read of what it is made on, as `If-Match`; it is refused if anybody
    else has changed that since. A program that has not read it decides on what is there now.

    `url`: of the service, e.g. "http://127.0.0.1:8000"; `token`: sent with each request; `timeout_s`: for an answer.
    """

    def __init__(self, url: str, token: str = "", timeout_s: float = 60.0) -> None:
        self.url, self._headers = url.rstrip("/"), {"Authorization": f"Bearer {token}"} if token else {}
        self._etags: dict[str, str] = {}
        try:
            self.http = httpx.Client(base_url=self.url, headers=self._headers, timeout=timeout_s)
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
        headers, document = httpx.Headers(more.pop("headers", None)), document_of(method, path, more.get("json"))
        if document and "if-match" not in headers and (etag := self._etag(document, path)):
            headers["if-match"] = etag
        if "json" in more:  # parts of an answer may be sent back, as the segments of `widths`
            more["json"] = to_jsonable_python(more["json"])
        answer = self._send(method, path, headers=headers, **more)
        if answer.is_success and (document or path == "/v1/stop"):
            self._take_etag(document, headers.get("if-match"), answer)
        if answer.is_success or answer.status_code == httpx.codes.NOT_MODIFIED:
            return answer
        try:
            problem = answer.json()
        except ValueError:
            problem = None
        raise refused(f"{method} {answer.request.url.path}", answer.status_code, problem, answer.text)

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

    def _send(self, method: str, path: str, **more: Any) -> httpx.Response:
        try:
            answer = self.http.request(method, path, **more)
        except (httpx.RequestError, httpx.InvalidURL) as error:
            raise self._unreachable(error) from error
        if method == "GET":
            self._etags.pop(answer.request.url.path, None)
            if "etag" in answer.headers or answer.status_code == httpx.codes.FORBIDDEN:
                self._etags[answer.request.url.path] = answer.headers.get("etag", "")
        return answer

    def _etag(self, document: str, path: str) -> str:
        """Return the version of what is decided on; it is read now if it was not before.

        A controller's key cannot read the participant of a test: its trials are planned with the model.
        """
        for place in (document, f"{document}/model") if path == "/v1/tests" else (document,):
            if place not in self._etags and self._send("GET", place).status_code == httpx.codes.NOT_FOUND:
                return self._etags.get(place, "")  # a calibration that waits to be stored has a version with its 404
            if etag := self._etags.get(place):
                return etag
        return ""

    def _take_etag(self, document: str, sent: str | None, answer: httpx.Response) -> None:
        """Take over the version to which a decision has led wherever the one before it was read: with models, too."""
        of_rig = document or "/v1/rig"
        if of_rig.startswith("/v1/rig") or of_rig.endswith("/calibration"):  # there is another version now
            self._etags = {place: etag for place, etag in self._etags.items() if not place.startswith(of_rig)}
        elif "etag" in answer.headers and not answer.request.url.path.endswith("/calibration"):
            new = answer.headers["etag"]
            self._etags = {place: new if etag == sent else etag for place, etag in self._etags.items()}

    def _unreachable(self, error: Exception) -> Unreachable:
        why = str(error) or type(error).__name__
        return Unreachable(self.url, "the service cannot be reached", f"{why}. Is `stimrig serve` running there?")

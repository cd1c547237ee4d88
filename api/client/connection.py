"""One connection to a service: requests, their errors, and the live channel."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Self

import httpx
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from api.client.errors import Unreachable, refused


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

        Returns
        -------
        httpx.Response
            With a status of success, or 304.

        Raises
        ------
        Unreachable
            There was no answer.
        Refused
            The answer is a problem. Its class tells the status: `NotFound`, `Conflict`, `Invalid`, …
        """
        try:
            answer = self.http.request(method, path, **more)
        except (httpx.RequestError, httpx.InvalidURL) as error:
            raise self._unreachable(error) from error
        if answer.is_success or answer.status_code == httpx.codes.NOT_MODIFIED:
            return answer
        try:
            problem = answer.json()
        except ValueError:
            problem = None
        raise refused(f"{method} {answer.request.url.path}", answer.status_code, problem, answer.text)

    def get(self, path: str, **more: Any) -> Any:
        """The JSON document at a path."""
        return self.request("GET", path, **more).json()

    def post(self, path: str, **more: Any) -> Any:
        """Send, and return the JSON document of the answer."""
        return self.request("POST", path, **more).json()

    def messages(self, path: str) -> Iterator[dict[str, Any]]:
        """JSON messages of a WebSocket until the service closes it.

        Raises
        ------
        Unreachable, Refused
        """
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

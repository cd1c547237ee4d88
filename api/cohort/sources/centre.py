"""Records at a centre: `GET /v1/recordings`, page by page, and `GET /v1/recordings/{id}`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.client.connection import Connection
from stimrig.api.client.errors import ServiceError
from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.fields import as_day
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, Source, SourceError

MOST_PAGES = 1_000_000
"""A centre that answers the same page for ever is not believed."""


@dataclass(frozen=True)
class Centre(Source):
    """A centre by its address and a token that may read."""

    url: str
    token: str = field(repr=False)

    def entries(self, selection: Selection) -> Iterator[Entry]:
        """Recordings page by page; what the selection says of participant, rig and day is asked of the centre."""
        after, seen = "", set[str]()
        try:
            with Connection(self.url, self.token) as line:
                for _ in range(MOST_PAGES):
                    asked = {**selection.hints, **({"after": after} if after else {})}
                    page = line.get("/v1/recordings", params=asked)
                    for document in page["recordings"]:
                        yield self._entry(document)
                    after = str(page.get("after") or "")
                    if not after or after in seen:
                        return
                    seen = {after}
        except ServiceError as error:
            raise CohortError(f"{self.url}: {_line(error)}") from error
        except (KeyError, TypeError, ValueError, AttributeError):
            raise CohortError(f"{self.url}: its answer is no list of recordings. Is it a centre?") from None

    def _entry(self, document: dict[str, Any]) -> Entry:
        """A recording as the centre lists it: `file` is the SHA-256 of its file, null where the rig has not sent it."""
        number, name = int(document["id"]), str(document["recording_id"])
        sha256, size = str(document.get("file") or ""), document.get("file_bytes")
        known: dict[str, Any] = {"name": name, "origin": self.url, "record_id": name}
        known |= {key: document[key] for key in ("participant", "rig", "test_id") if isinstance(document.get(key), str)}
        known["day"] = as_day(str(document.get("created_utc") or ""))
        known["begun_utc"] = document.get("created_utc")
        if size is not None:
            known["bytes"] = size = int(size)
        address = f"{self.url}/v1/recordings/{number}"
        return Entry(address, name, str(number), size, sha256, sha256, known)

    def open(self, entry: Entry, most_bytes: int) -> bytes:
        """The recording's bytes."""
        try:
            with Connection(self.url, self.token) as line:
                return _bounded(line, f"/v1/recordings/{entry.key}", most_bytes)
        except ServiceError as error:
            raise SourceError(f"cannot be fetched ({_line(error)})") from None


def _bounded(line: Connection, path: str, most_bytes: int) -> bytes:
    """An answer's bytes, no more than wanted: a centre may be anybody."""
    import httpx

    from stimrig.api.client.errors import Unreachable, refused

    try:
        with line.http.stream("GET", path) as answer:
            if not answer.is_success:
                answer.read()
                try:
                    problem = answer.json()
                except ValueError:
                    problem = None
                raise refused(f"GET {path}", answer.status_code, problem, answer.text)
            content = bytearray()
            for piece in answer.iter_bytes():
                content += piece
                if len(content) > most_bytes:
                    break
            return bytes(content)
    except httpx.HTTPError as error:
        raise Unreachable(line.url, "the service cannot be reached", str(error)) from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:300].rstrip(".")

"""Where records lie: a source lists them one after the other, and opens one, here or on a worker.

Files and folders, addresses of fsspec, and a centre's REST interface. A source is sent to the workers, so it holds
addresses and settings, never an open connection. fsspec's keys and servers come from where it looks for them (for S3:
the variables and files of AWS, `FSSPEC_S3_*`), here and on the workers; no key is sent.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from stimrig.api.client.connection import Connection
from stimrig.api.client.errors import ServiceError
from stimrig.api.cohort.select import Selection, as_day
from stimrig.api.cohort.tasks import CohortError
from stimrig.api.settings import loopback

SUFFIXES = (".h5", ".hdf5", ".csv", ".tsv", ".txt", ".mat")
"""What counts as a record in a folder. A file that is named itself is taken whatever its name."""


@dataclass(frozen=True)
class Entry:
    """One record as a source lists it."""

    address: str  # what names it among all, and for people: a path, a URL
    name: str  # name of the file, or id at a centre
    key: str  # what `open` takes
    bytes: int | None = None  # size, where the listing says it
    stamp: str = ""
    """Changes whenever the content does: time of change, ETag, hash. Empty: not known."""
    sha256: str = ""  # of the content, where the listing says it
    known: dict[str, Any] = field(default_factory=dict)
    """Fields (`stimrig.api.cohort.select`) that are known without reading the record."""


class SourceError(Exception):
    """A record cannot be fetched: one line, for its row."""


class Source(Protocol):
    """A place with records."""

    def check(self) -> None:
        """Look whether the place is there, before workers are started for it.

        Raises CohortError: it is not there, or does not let us in.
        """
        next(self.entries(Selection()), None)

    def entries(self, selection: Selection) -> Iterator[Entry]:
        """Every record, one after the other; those that cannot be meant may be left out.

        Raises CohortError: the place is not there, or does not let us in.
        """
        ...

    def open(self, entry: Entry, most_bytes: int) -> bytes:
        """The content of a record, of a larger one its first `most_bytes` + 1.

        Raises SourceError: it cannot be fetched.
        """
        ...


def is_record(name: str) -> bool:
    return not name.startswith((".", "_")) and name.lower().endswith(SUFFIXES)


@dataclass(frozen=True)
class Folder:
    """A file, or a folder with all that is in it."""

    path: str

    def check(self) -> None:
        """Whether the path is there."""
        if not os.path.lexists(self.path):
            raise CohortError(f"{self.path}: no such file or folder. Give a path, s3://… or https://…")

    def entries(self, selection: Selection) -> Iterator[Entry]:
        """Files as the system lists them, so that none but the present one is held in memory."""
        del selection  # what a file says of itself is known once it is read
        place = Path(self.path)
        if place.is_file():
            yield self._entry(place)
        elif place.is_dir():
            yield from self._within(str(place))
        else:
            raise CohortError(f"{self.path}: neither a file nor a folder. Give a path, s3://… or https://…")

    def _within(self, folder: str) -> Iterator[Entry]:
        try:
            with os.scandir(folder) as found:
                for item in found:
                    if item.is_dir(follow_symlinks=False):
                        if not item.name.startswith("."):
                            yield from self._within(item.path)
                    elif is_record(item.name) and item.is_file():  # a link to a file counts; a pipe would never end
                        yield self._entry(Path(item.path))
        except OSError:  # opened as a record it gives the reason, as its row
            yield Entry(_sound(folder), _sound(Path(folder).name), folder, known={"origin": _sound(self.path)})

    def _entry(self, path: Path) -> Entry:
        whole = path.absolute()
        address, name = _sound(str(whole)), _sound(path.name)
        known = {"name": name, "origin": _sound(self.path)}
        try:
            found = whole.stat()
        except OSError:  # a link to nowhere: its row will say so
            return Entry(address, name, os.fspath(whole), known=known)
        stamp = f"{found.st_size}:{found.st_mtime_ns}"
        return Entry(address, name, os.fspath(whole), found.st_size, stamp, known={**known, "bytes": found.st_size})

    def open(self, entry: Entry, most_bytes: int) -> bytes:
        try:
            # Not blocking: a pipe that took the file's place since would never end.
            with os.fdopen(os.open(entry.key, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
                return file.read(most_bytes + 1)
        except OSError as error:
            raise SourceError(f"cannot be read ({error.strerror or error})") from None


def _sound(text: str) -> str:
    """A path as a text that can be stored: a name on a disk may be no UTF-8."""
    return text.encode("utf-8", "replace").decode()


@dataclass(frozen=True)
class Bucket(Source):
    """An address with a protocol of fsspec."""

    url: str

    def entries(self, selection: Selection) -> Iterator[Entry]:
        """Objects below the address, in the order of their names, one folder in memory at a time."""
        del selection  # what a file says of itself is known once it is read
        files, path = self._files()
        try:
            if files.isfile(path):
                yield self._entry(files, files.info(path))
                return
            if not files.exists(path):
                raise CohortError(f"{self.url}: nothing is there. Check the address.")
            yield from self._within(files, path)
        except CohortError:
            raise
        except Exception as error:  # each protocol has errors of its own
            raise CohortError(f"{self.url}: {_line(error)}. Check the address, the network and the keys.") from error

    def _within(self, files: Any, folder: str) -> Iterator[Entry]:
        found = files.ls(folder, detail=True)
        for item in sorted(found, key=lambda one: one["name"]):
            name = item["name"].rstrip("/").rpartition("/")[2]
            if item["name"].rstrip("/") == folder.rstrip("/"):
                continue
            if item["type"] == "directory":
                if not name.startswith("."):
                    yield from self._within(files, item["name"])
            elif is_record(name):
                yield self._entry(files, item)
        files.invalidate_cache(folder)  # a listing of millions must not stay in memory

    def _entry(self, files: Any, item: dict[str, Any]) -> Entry:
        name = item["name"].rpartition("/")[2]
        size = item.get("size")
        stamp = next((str(item[key]) for key in ("ETag", "etag", "LastModified", "mtime") if item.get(key)), "")
        known = {"name": name, "origin": self.url, **({} if size is None else {"bytes": int(size)})}
        stamp = f"{size}:{stamp}" if stamp else ""
        return Entry(files.unstrip_protocol(item["name"]), name, item["name"], size, stamp, known=known)

    def open(self, entry: Entry, most_bytes: int) -> bytes:
        if entry.bytes == 0:
            return b""  # a part of nothing cannot be asked for
        try:
            files, _ = self._files()
            return files.cat_file(entry.key, start=0, end=most_bytes + 1)
        except Exception as error:
            raise SourceError(f"cannot be fetched ({_line(error)})") from None

    def _files(self) -> tuple[Any, str]:
        """The file system and the path in it."""
        import fsspec

        try:
            return fsspec.core.url_to_fs(self.url, use_listings_cache=False)
        except (ImportError, ValueError) as error:
            protocol = self.url.partition("://")[0]
            raise CohortError(f"{self.url}: {protocol}:// cannot be used here ({_line(error)}).") from None


def _line(error: BaseException, most: int = 200) -> str:
    return " ".join(str(error).split())[:most].rstrip(".") or type(error).__name__


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
            raise CohortError(f"{self.url}: {_line(error, 300)}") from error
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
        try:
            with Connection(self.url, self.token) as line:
                return line.content(f"/v1/recordings/{entry.key}", most_bytes)
        except ServiceError as error:
            raise SourceError(f"cannot be fetched ({_line(error, 300)})") from None


def sources_of(addresses: Sequence[str], token: str = "", scheduler: str = "") -> list[Source]:
    """A source for each address; `scheduler`: where they are sent to, with the token; empty: to this machine only.

    Raises CohortError: an address that cannot be used, a centre without a token, or a token that would travel in the
    clear.
    """
    if not addresses:
        raise CohortError("DATA is missing. Give files, folders, s3://… or the https://… of a centre.")
    sources = [_source(address, token) for address in addresses]
    if any(isinstance(source, Centre) for source in sources) and scheduler and not scheduler.startswith("tls://"):
        raise CohortError(
            f"--scheduler {scheduler}: the token would go on to the workers in the clear, wherever they are. "
            "Start the scheduler with TLS and give tls://… (docs/cohorts.md)."
        )
    return sources


def _source(address: str, token: str) -> Source:
    protocol, separator, rest = address.partition("://")
    if not separator:
        return Folder(str(Path(address)))
    if protocol in ("http", "https"):
        if not token:
            raise CohortError(f"{address}: a centre needs a token. Set STIMRIG_TOKEN, or give --token.")
        if protocol == "http" and not loopback(urlsplit(address).hostname or ""):
            raise CohortError(f"{address}: the token would be sent in the clear. Give https://…")
        return Centre(address.rstrip("/"), token)
    if protocol == "file":
        return Folder(rest)
    return Bucket(address)

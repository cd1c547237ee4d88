"""Where records lie: a source lists them one after the other, and opens one, here or on a worker.

Files and folders, and addresses of fsspec. A source is sent to the workers, so it holds addresses and settings, never
an open connection. fsspec's keys and servers come from where it looks for them (for S3:
the variables and files of AWS, `FSSPEC_S3_*`), here and on the workers; no key is sent.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from stimrig.api.cohort.tasks import CohortError

SUFFIXES = (".h5", ".hdf5", ".csv", ".tsv", ".txt", ".mat")
"""What counts as a record in a folder: no Parquet file, which may be results. A file that is named itself is taken
whatever its name."""
EXPORT_TABLES = ("records.csv", "errors.csv")
"""The two tables that `stimrig export` writes beside the records of its folder."""


@dataclass(frozen=True)
class Entry:
    """One record as a source lists it."""

    address: str  # what names it among all, and for people: a path, a URL
    name: str  # name of the file
    key: str  # what `open` takes
    bytes: int | None = None  # size, where the listing says it
    stamp: str = ""
    """Changes whenever the content does: time of change, ETag, hash. Empty: not known."""
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
        next(self.entries(), None)

    def entries(self) -> Iterator[Entry]:
        """List every record, one after the other.

        Raises CohortError: the place is not there, or does not let us in.
        """
        ...

    def open(self, entry: Entry, most_bytes: int) -> bytes:
        """The content of a record, of a larger one its first `most_bytes` + 1.

        Raises SourceError: it cannot be fetched.
        """
        ...


def is_record(name: str, exported: bool) -> bool:
    """Return whether a folder's file may be a record; `exported`: the folder holds both tables of an export."""
    if exported and name in EXPORT_TABLES:
        return False
    return not name.startswith((".", "_")) and name.lower().endswith(SUFFIXES)


@dataclass(frozen=True)
class Folder:
    """A file, or a folder with all that is in it."""

    path: str

    def check(self) -> None:
        """Whether the path is there."""
        if not os.path.lexists(self.path):
            raise CohortError(f"{self.path}: no such file or folder. Give a path, s3://… or https://…")

    def entries(self) -> Iterator[Entry]:
        """Files as the system lists them, so that none but the present one is held in memory."""
        place = Path(self.path)
        if place.is_file():
            yield self._entry(place)
        elif place.is_dir():
            yield from self._within(str(place))
        else:
            raise CohortError(f"{self.path}: neither a file nor a folder. Give a path, s3://… or https://…")

    def _within(self, folder: str) -> Iterator[Entry]:
        exported = all(Path(folder, name).is_file() for name in EXPORT_TABLES)
        try:
            with os.scandir(folder) as found:
                for item in found:
                    if item.is_dir(follow_symlinks=False):
                        if not item.name.startswith("."):
                            yield from self._within(item.path)
                    elif is_record(item.name, exported) and item.is_file():  # a link counts; a pipe would never end
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

    def entries(self) -> Iterator[Entry]:
        """Objects below the address, in the order of their names, one folder in memory at a time."""
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
        exported = {item["name"].rpartition("/")[2] for item in found}.issuperset(EXPORT_TABLES)
        for item in sorted(found, key=lambda one: one["name"]):
            name = item["name"].rstrip("/").rpartition("/")[2]
            if item["name"].rstrip("/") == folder.rstrip("/"):
                continue
            if item["type"] == "directory":
                if not name.startswith("."):
                    yield from self._within(files, item["name"])
            elif is_record(name, exported):
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
        try:
            import fsspec

            return fsspec.core.url_to_fs(self.url, use_listings_cache=False)
        except (ImportError, ValueError) as error:
            protocol = self.url.partition("://")[0]
            raise CohortError(f"{self.url}: {protocol}:// cannot be used here ({_line(error)}).") from None


def _line(error: BaseException, most: int = 200) -> str:
    return " ".join(str(error).split())[:most].rstrip(".") or type(error).__name__


def sources_of(addresses: Sequence[str]) -> list[Source]:
    """A source for each address. Raises CohortError: there is none, or one cannot be used."""
    if not addresses:
        raise CohortError("DATA is missing. Give files, folders, or addresses like s3://….")
    return [_source(address) for address in addresses]


def _source(address: str) -> Source:
    protocol, separator, rest = address.partition("://")
    if not separator:
        return Folder(str(Path(address)))
    if protocol == "file":
        return Folder(rest)
    return Bucket(address)

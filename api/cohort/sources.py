"""Records in files, folders and buckets: list them one after the other, and read the content of one.

A bucket is any address that fsspec knows. Its keys and servers come from where fsspec looks for them (for S3 the
variables and files of AWS, `FSSPEC_S3_*`), on this machine and on the workers; no key is sent.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stimrig.api.cohort.errors import CohortError
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES

SUFFIXES = (".h5", ".hdf5", ".csv", ".tsv", ".txt", ".mat")
"""Suffixes of records in a folder; Parquet files may be results. A file that is named itself needs none of them."""
EXPORT_TABLES = ("records.csv", "errors.csv")
"""The two tables that `stimrig export` writes beside the records of its folder."""


@dataclass(frozen=True)
class Entry:
    """A record as it is listed."""

    address: str  # path or URL, as results name it
    path: str  # path that opens it
    bucket: str = ""  # the address of DATA, as fsspec opens it; empty: a file of this machine
    stamp: str = ""
    """Changes with the content: size and time of change, or ETag. Empty: unknown."""
    known: dict[str, Any] = field(default_factory=dict)
    """Fields (`stimrig.api.cohort.select`) that are known before the record is read: name, origin, bytes."""

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.known["name"]


class SourceError(Exception):
    """The record cannot be fetched, or is too large: kind and one line, for its row."""

    def __init__(self, kind: str, line: str) -> None:
        super().__init__(line)
        self.kind = kind


def count_records(addresses: Sequence[str]) -> int:
    """Count the records below the addresses. Raises CohortError: there is no address, or one that cannot be used."""
    if not addresses:
        raise CohortError("DATA is missing. Give files, folders, or addresses like s3://….")
    return sum(1 for _ in list_records(addresses))


def list_records(addresses: Sequence[str]) -> Iterator[Entry]:
    """List every record below the addresses. Raises CohortError: an address is missing, or access is denied."""
    for address in addresses:
        protocol, separator, path = address.partition("://")
        if separator and protocol != "file":
            yield from _list_bucket(address)
        else:
            yield from _list_folder(Path(path if separator else address))


def read_content(entry: Entry) -> bytes:
    """Return the content of a record. Raises SourceError."""
    size, content = entry.known.get("bytes", 1), b""
    try:
        if size > LARGEST_FILE_BYTES:
            pass
        elif entry.bucket and size:  # an empty range cannot be requested
            content = _open_bucket(entry.bucket)[0].cat_file(entry.path, start=0, end=LARGEST_FILE_BYTES + 1)
        elif not entry.bucket:
            # Not blocking: a pipe in the file's place would never end.
            with os.fdopen(os.open(entry.path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
                content = file.read(LARGEST_FILE_BYTES + 1)
    except Exception as error:  # each protocol has errors of its own
        raise SourceError("unreadable", f"cannot be read ({_one_line(error)})") from None
    if max(size, len(content)) > LARGEST_FILE_BYTES:
        limit = f"more than {LARGEST_FILE_BYTES // 2**20} MB. Cut the record, or give the sealed recording."
        raise SourceError("bad record", limit)
    return content


def _records_of(names: Iterable[str]) -> list[str]:
    """Return the names of a folder's files that may be records."""
    tables = set(EXPORT_TABLES) if set(EXPORT_TABLES) <= set(names) else set()
    visible = (name for name in names if name not in tables and not name.startswith((".", "_")))
    return sorted(name for name in visible if name.lower().endswith(SUFFIXES))


def _list_folder(place: Path) -> Iterator[Entry]:
    def refuse(error: OSError) -> None:
        raise CohortError(f"{error.filename}: {error.strerror}. Give a folder that can be read.") from None

    if place.is_file():
        yield _file_entry(place, place)
    elif not place.is_dir():
        raise CohortError(f"{place}: no such file or folder. Give a path, s3://… or https://…")
    else:
        for folder, folders, names in os.walk(place, onerror=refuse):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for path in (Path(folder, name) for name in _records_of(names)):
                if path.is_file():  # a link counts, a pipe does not
                    yield _file_entry(path, place)


def _file_entry(path: Path, origin: Path) -> Entry:
    path, size, stamp = path.absolute(), None, ""
    with contextlib.suppress(OSError):  # gone since: its row will say so
        status = path.stat()
        size, stamp = status.st_size, f"{status.st_size}:{status.st_mtime_ns}"
    return _entry(str(path), str(path), str(origin), size, stamp)


def _entry(address: str, path: str, origin: str, size: int | None, stamp: str, bucket: str = "") -> Entry:
    # The name of a file may not be UTF-8, which results cannot store.
    address, origin = (text.encode("utf-8", "replace").decode() for text in (address, origin))
    known = {"name": address.rstrip("/").rpartition("/")[2], "origin": origin}
    return Entry(address, path, bucket, stamp, known if size is None else {**known, "bytes": size})


def _open_bucket(url: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    import fsspec

    return fsspec.core.url_to_fs(url, use_listings_cache=False)


def _list_bucket(url: str) -> Iterator[Entry]:
    try:
        files, path = _open_bucket(url)
        if files.isfile(path):
            yield _object_entry(files, files.info(path), url)
            return
        if not files.exists(path):
            raise CohortError(f"{url}: nothing is there. Check the address.")
        for _, folders, objects in files.walk(path, detail=True, on_error="raise"):
            for hidden in [name for name in folders if name.startswith(".")]:
                del folders[hidden]
            for name in _records_of(objects):
                yield _object_entry(files, objects[name], url)
    except CohortError:
        raise
    except ImportError as error:
        raise CohortError(f"{url}: {_one_line(error)}. For buckets: pip install 'stimrig[s3]'.") from error
    except Exception as error:  # each protocol has errors of its own
        raise CohortError(f"{url}: {_one_line(error)}. Check the address, the network and the keys.") from error


def _object_entry(files: Any, item: dict[str, Any], url: str) -> Entry:
    size = item.get("size")
    version = next((item[key] for key in ("ETag", "etag", "LastModified", "mtime") if item.get(key)), "")
    stamp = f"{size}:{version}" if version else ""
    return _entry(files.unstrip_protocol(item["name"]), item["name"], url, size, stamp, url)


def _one_line(error: BaseException) -> str:
    words = (isinstance(error, OSError) and error.strerror) or str(error)
    return " ".join(words.split())[:200].rstrip(".") or type(error).__name__

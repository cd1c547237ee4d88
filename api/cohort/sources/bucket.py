"""Records at an address that fsspec knows: `s3://bucket/prefix`, and others where their package is installed.

Keys and servers come from where fsspec looks for them (for S3: the variables and files of AWS, `FSSPEC_S3_*`), here and
on the workers; no key is sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, Source, SourceError, is_record


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
        """The object's bytes."""
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


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__

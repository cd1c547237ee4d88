"""Records in files and folders of this machine, or of a disk that the workers share with it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, SourceError, is_record


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
        """The file's bytes."""
        try:
            # Not blocking: a pipe that took the file's place since would never end.
            with os.fdopen(os.open(entry.key, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
                return file.read(most_bytes + 1)
        except OSError as error:
            raise SourceError(f"cannot be read ({error.strerror or error})") from None


def _sound(text: str) -> str:
    """A path as a text that can be stored: a name on a disk may be no UTF-8."""
    return text.encode("utf-8", "replace").decode()

"""Where records lie: a source lists them one after the other, and opens one, here or on a worker.

One file each: `folder` (files and folders), `bucket` (addresses of fsspec), `centre` (a centre's REST interface). A
source is sent to the workers, so it holds addresses and settings, never an open connection.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

from stimrig.api.cohort.select import Selection

SUFFIXES = (".h5", ".hdf5", ".csv", ".tsv", ".txt", ".mat")
"""What counts as a record in a folder. A file that is named itself is taken whatever its name."""


@dataclass(frozen=True)
class Entry:
    """One record as a source lists it.

    Attributes
    ----------
    address : str
        What names it among all, and for people: a path, a URL.
    name : str
        Name of the file, or id at a centre.
    key : str
        What `open` takes.
    bytes : int or None
        Size, where the listing says it.
    stamp : str
        Changes whenever the content does: time of change, ETag, hash. Empty: not known.
    sha256 : str
        Of the content, where the listing says it.
    known : dict
        Fields (`stimrig.api.cohort.fields`) that are known without reading the record.
    """

    address: str
    name: str
    key: str
    bytes: int | None = None
    stamp: str = ""
    sha256: str = ""
    known: dict[str, Any] = field(default_factory=dict)


class SourceError(Exception):
    """A record cannot be fetched: one line, for its row."""


class Source(Protocol):
    """A place with records."""

    def check(self) -> None:
        """Look whether the place is there, before workers are started for it.

        Raises
        ------
        CohortError
            It is not there, or does not let us in.
        """
        next(self.entries(Selection()), None)

    def entries(self, selection: Selection) -> Iterator[Entry]:
        """Every record, one after the other; those that cannot be meant may be left out.

        Raises
        ------
        CohortError
            The place is not there, or does not let us in.
        """
        ...

    def open(self, entry: Entry, most_bytes: int) -> bytes:
        """The content of a record, of a larger one its first `most_bytes` + 1.

        Raises
        ------
        SourceError
            It cannot be fetched.
        """
        ...


def is_record(name: str) -> bool:
    """Whether a file in a folder counts as a record."""
    return not name.startswith((".", "_")) and name.lower().endswith(SUFFIXES)

"""Whole files, each under its SHA-256: a folder, or whatever fsspec reaches, such as S3."""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.whole_file import whole_file

PIECE = 2**20
PROBE = "stimrig-centre"
"""A small file that says whether the bucket can be written."""
GONE = "it is gone, or not mounted"


class BucketError(Exception):
    """The bucket cannot be reached, is full, or refuses; one line."""


class MissingError(BucketError):
    """The bucket has no such file."""


class Bucket:
    """The centre's files.

    `url`: a folder, ``file://…``, ``s3://bucket/prefix``, or another address that fsspec knows. Raises SettingsError:
    fsspec or the driver is not installed, or the address cannot be read.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            import fsspec
        except ImportError:
            raise SettingsError("the centre needs more packages: pip install 'stimrig[centre]'") from None
        try:
            # another process may have changed what is there
            found, root = fsspec.core.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
        except (ImportError, ValueError, OSError) as error:
            raise SettingsError(f"STIMRIG_CENTRE_FILES: {url}: {first_line(error)}") from error
        self.fs: Any = found
        self.root = str(root).rstrip("/")
        self.local = "file" in (self.fs.protocol if isinstance(self.fs.protocol, tuple) else (self.fs.protocol,))
        self.trouble: str | None = None
        """Why the last try failed."""

    def name(self, sha256: str) -> str:
        return f"{self.root}/{sha256[:2]}/{sha256}"

    def ready(self, begin: bool = False) -> None:
        """See that it is there and can be written; only at the beginning may it be one that was never used.

        Later, a folder without its mark is one whose disk is not mounted. Raises BucketError.
        """
        with self._told():
            mark = f"{self.root}/{PROBE}"
            if not begin and not self.fs.exists(mark):
                raise FileNotFoundError(2, GONE)
            self.fs.pipe_file(mark, b"stimrig\n")

    def put(self, path: Path, sha256: str) -> None:
        """Copy a whole file in; under its name it is whole or not there. Raises BucketError."""
        with self._told():
            if self.local:
                self._put_local(path, Path(self.name(sha256)))
            else:  # an object store shows an object once it is whole
                self.fs.put_file(str(path), self.name(sha256))

    def _put_local(self, path: Path, final: Path) -> None:
        if not (Path(self.root) / PROBE).exists():
            raise FileNotFoundError(2, GONE)
        final.parent.mkdir(mode=0o700, exist_ok=True)
        part = final.with_name(f"{final.name}.{secrets.token_hex(4)}.part")
        # what is not there for good was not taken
        with path.open("rb") as source, whole_file(final, part, 0o600, must_last=True) as out:
            shutil.copyfileobj(source, out, PIECE)

    def copy(self, sha256: str, out: IO[bytes] | None = None, seen: Callable[[int], object] | None = None) -> bool:
        """Read a file, into `out` if given; whether it is what its name says.

        Raises MissingError: the bucket is there, and the file is not in it. BucketError: the bucket is gone, or cannot
        be read.
        """
        found = hashlib.sha256()
        try:
            with self._told(), self.fs.open(self.name(sha256), "rb") as file:
                while piece := file.read(PIECE):
                    found.update(piece)
                    if out is not None:
                        out.write(piece)
                    if seen is not None:
                        seen(len(piece))
        except MissingError as error:
            self._here(error)
            raise
        return found.hexdigest() == sha256

    def _here(self, missing: MissingError) -> None:
        """Where the mark lacks, too, no file is lost: the disk is not mounted. Raises BucketError."""
        with self._told():
            here = self.fs.exists(f"{self.root}/{PROBE}")
        if not here:
            self.trouble = f"{self.url}: {GONE}"
            raise BucketError(self.trouble) from missing

    def remove(self, sha256: str) -> None:
        """Take a file away, if it is there. Raises BucketError: it stays."""
        with contextlib.suppress(MissingError), self._told():
            self.fs.rm_file(self.name(sha256))

    @contextlib.contextmanager
    def _told(self):
        try:
            yield
        except FileNotFoundError as error:
            self.trouble = f"{self.url}: {first_line(error)}"
            raise MissingError(self.trouble) from error
        except Exception as error:  # each driver has errors of its own
            self.trouble = f"{self.url}: {first_line(error)}"
            raise BucketError(self.trouble) from error
        self.trouble = None


def first_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


def failed(error: Exception) -> ApiError:
    """507: the rig keeps what it has, and tries again."""
    return ApiError(507, "bucket-failed", "The file cannot be kept at the moment", f"{error}. Try again later.")

"""The centre's settings and parts, made once and handed to its routes; what those of `api.web` ask is here, too."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

from fastapi import Depends, Request
from pydantic import Field
from pydantic_settings import SettingsConfigDict

from stimrig.api import owner_only
from stimrig.api.centre import check, warnings
from stimrig.api.centre.bucket import Bucket, BucketError
from stimrig.api.centre.heads import Heads
from stimrig.api.centre.ingest import Ingest
from stimrig.api.centre.rigs import Rigs
from stimrig.api.centre.spool import Spool
from stimrig.api.clock import Clock, set_zone
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.settings import ServerSettings
from stimrig.api.store import Store
from stimrig.api.store.holds import shared_secret
from stimrig.api.web.dependencies import Parts

MOST_DOWNLOADS, MOST_PUTS, MOST_PUTS_OF_A_RIG = 4, 8, 3


class CentreSettings(ServerSettings):
    """Settings of the centre: ``data_dir`` is ``STIMRIG_CENTRE_DATA_DIR``."""

    model_config = SettingsConfigDict(env_prefix="STIMRIG_CENTRE_", extra="ignore")
    centre_url: ClassVar[None] = None
    """A centre tells no other one."""
    structure: ClassVar[tuple[str, ...]] = ()
    """A centre fits nothing."""

    data_dir: Path = Field(default=Path("centre"), description="files that are coming in, and logs")
    database_url: str | None = Field(
        default=None,
        description="as postgresql+psycopg://user:password@host/stimrig; default: SQLite in the data folder",
    )
    files: str | None = Field(
        default=None, description="the bucket: a folder, file:// or s3://bucket/prefix; default: in the data folder"
    )
    port: Annotated[int, Field(ge=0, le=65535)] = 8100
    max_file_mb: Annotated[float, Field(gt=0)] = Field(default=4096.0, description="longest file that is taken, MB")

    @property
    def database(self) -> str:
        return self.database_url or f"sqlite:///{self.data_dir.absolute() / 'centre.db'}"

    @property
    def bucket(self) -> str:
        """Where whole files lie."""
        return self.files or str(self.data_dir.absolute() / "files")

    @property
    def spool_dir(self) -> Path:
        return self.data_dir / "spool"


class Context(Parts):
    """Everything a route of the centre may need."""

    forgiven = (*Parts.forgiven, BucketError)

    def __init__(self, settings: CentreSettings, clock: Clock, store: Store, bucket: Bucket) -> None:
        super().__init__(settings, clock, store)
        self.settings, self.bucket = settings, bucket
        self.rigs = Rigs(store, clock, self.guesses)
        self.ingest = Ingest(store, clock, int(settings.max_file_mb * 1e6))
        self.heads = Heads(store, shared_secret(store, "receipts"))
        self.spool = Spool(settings.spool_dir, store, clock, bucket)
        self.downloads = asyncio.Semaphore(MOST_DOWNLOADS)
        """So many files are read from the bucket at the same time."""
        self.bucket_threads = ThreadPoolExecutor(MOST_DOWNLOADS + MOST_PUTS, "bucket")
        """For the bucket alone: one that does not answer keeps neither pages nor items waiting."""
        self.puts = asyncio.Semaphore(MOST_PUTS)
        """So many pieces of files are taken at the same time."""
        self.putting: Counter[int] = Counter()
        """Of each rig, how many are on their way."""
        self.waiting_warnings = 0
        """As many as were there when they were counted last: for the bar of pages, and for nothing else."""

    def regular(self) -> list[tuple[float, Callable[[], object]]]:
        """As `Parts`; and files are looked through."""
        return [*super().regular(), (check.EVERY_S, lambda: check.look(self.spool))]

    @contextlib.contextmanager
    def one_more_of(self, rig_id: int) -> Iterator[None]:
        """Around a piece of a rig's file: a rig sends one, and one more after a line that broke; each is in memory.

        Raises ApiError: 503 there are as many.
        """
        if self.putting[rig_id] >= MOST_PUTS_OF_A_RIG:
            raise ApiError(503, "crowded", "Too many pieces at once", "Send one after the other. Try again later.")
        self.putting[rig_id] += 1
        try:
            yield
        finally:
            self.putting[rig_id] -= 1

    async def with_bucket(self, what: Callable[..., Any], *given: Any) -> Any:
        """Do what may wait for the bucket."""
        return await asyncio.get_running_loop().run_in_executor(self.bucket_threads, partial(what, *given))

    async def count_warnings(self) -> None:
        """Count those that nobody has acknowledged."""
        self.waiting_warnings = await asyncio.to_thread(warnings.open_count, self.store)

    async def close(self) -> None:
        self.bucket_threads.shutdown(wait=False, cancel_futures=True)
        await super().close()


def build(settings: CentreSettings, clock: Clock | None = None) -> Context:
    """Make the parts.

    Raises ApiError: the database cannot be opened. SettingsError: the bucket is not there, or a package is missing.
    """
    clock = clock or Clock()
    try:
        owner_only.folder(settings.data_dir)
        owner_only.folder(settings.spool_dir)
        shutil.rmtree(settings.exports_dir, ignore_errors=True)
        owner_only.folder(settings.exports_dir)
    except OSError as error:
        detail = f"{settings.data_dir}: {error.strerror}; set STIMRIG_CENTRE_DATA_DIR to a folder this user may write"
        raise SettingsError(detail) from error
    if settings.time_zone:
        set_zone(settings.time_zone)
    bucket = ready_bucket(settings)
    return Context(settings, clock, open_store(settings), bucket)


def ready_bucket(settings: CentreSettings) -> Bucket:
    """The bucket, which is there. Raises SettingsError."""
    if settings.files is None:
        owner_only.folder(settings.data_dir / "files")
    bucket = Bucket(settings.bucket)
    try:
        bucket.ready(begin=True)
    except BucketError as error:
        raise SettingsError(f"STIMRIG_CENTRE_FILES: {error}; give a folder or bucket that can be written") from error
    return bucket


def open_store(settings: CentreSettings) -> Store:
    """The database. Raises ApiError, in whose line the centre's settings stand."""
    try:
        return Store(settings.database)
    except ApiError as error:
        error.args = (str(error).replace("STIMRIG_DA", "STIMRIG_CENTRE_DA"),)
        raise


async def from_request(request: Request) -> Context:
    """The application's context, as a dependency."""
    return request.app.state.context


Ctx = Annotated[Context, Depends(from_request)]

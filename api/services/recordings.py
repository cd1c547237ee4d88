"""Recordings: their files, and recordings of other tools taken in."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterable, Iterator, Sequence
from pathlib import Path

from sqlalchemy import or_, update

from stimrig.api.errors import ApiError, require_found
from stimrig.api.models import carried_structure
from stimrig.api.models.places import site_of
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.store import audit, locking, uploads
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Model, Recording
from stimrig.api.whole_file import sha256_of
from stimrig.identify.records import HDF5_MAGIC, PARQUET_MAGIC

MAGIC = {HDF5_MAGIC: ".h5", b"MATLAB ": ".mat", PARQUET_MAGIC: ".parquet"}
AT_ONCE = 500
"""Recordings whose samples one job reads."""


def find(context: Context, recording_id: str) -> tuple[Recording, Path]:
    """Return a recording and its file. Raises ApiError: 404 no such recording; 410 its file is gone."""
    row = context.store.get(Recording, recording_id)
    require_found(row, "recording", recording_id, "A test's document names its recording.")
    path = Path(row.path)
    if not path.is_file():
        detail = f"The file of recording {recording_id!r} is not in its place ({path.name}). Restore it from a backup."
        raise ApiError(410, "recording-gone", "The recording's file is missing", detail)
    return row, path


async def spool(context: Context, chunks: AsyncIterable[bytes], suffix: str) -> Path:
    """Write an upload to the disk as it comes; return the place that it gets once it is taken in.

    `suffix`: of the file; empty: as its first bytes say. Raises ApiError: 422 it is empty.
    """
    part = uploads.part_of(context.settings.recordings_dir / f"{uploads.PREFIX}{secrets.token_hex(8)}")
    start = b""
    try:
        with part.open("wb") as file:
            async for chunk in chunks:
                start = start if len(start) >= 16 else start + chunk[:16]
                await asyncio.to_thread(file.write, chunk)
        if not start:
            raise ApiError(422, "empty", "The upload is empty", "Send a CSV, MAT, Parquet or HDF5 file as the body.")
        suffix = suffix or next((kind for magic, kind in MAGIC.items() if start.startswith(magic)), ".csv")
        return uploads.whole_of(part.replace(part.with_suffix(suffix)))
    except BaseException:
        part.unlink(missing_ok=True)
        raise


async def take_in(
    context: Context,
    code: str,
    whole: Path,
    principal: Principal,
    tags: Tags,
    columns: Sequence[str] = (),
    of: str = "",
) -> tuple[Recording, Model, list[str]]:
    """Keep a spooled recording of another tool and identify a model from it; return what was assumed.

    Where `columns` are mapped, what is kept is the record as a CSV file of ours, with the SHA-256 of what was sent.

    Raises ApiError: 422 it cannot be read or fitted; 409 it is another participant's than `of` says. Nothing is kept of
    it.
    """
    part = uploads.part_of(whole)
    try:
        with _about_the_upload(part):
            assumed: list[str] = []
            if columns:
                out = str(part.with_suffix(".plain"))
                table = await context.pool.submit("plain_csv", data=str(part), out=out, columns=list(columns)).result
                await asyncio.to_thread(Path(out).replace, part)
                assumed = table["notes"]
            fitted = await context.analyses.run("fit", data=str(part))
        new = Recording(id=whole.stem, participant=code, test_id=None, path=str(whole), origin="upload")
        new.file_sha256 = await asyncio.to_thread(sha256_of, part)
        new.samples_sha256 = fitted.get("samples_sha256") or ""
        warnings = new.warnings = [note for note in (*assumed, *fitted["notes"]) if note]
        await _read_samples(context)
        of = await asyncio.to_thread(_other_owner, context, new, principal, fitted.get("of") or "", of)
    except BaseException:  # refused, or nobody waits for it any more
        for left in (part, part.with_suffix(".plain")):
            left.unlink(missing_ok=True)
        raise

    def keep() -> tuple[Recording, Model]:
        row = _store(context, new, principal.name, of, tags, fitted.get("current_ma"))
        return row, context.versions.add(fitted["json"], code, row.id, principal.name)

    row, plain = await asyncio.shield(asyncio.to_thread(keep))
    return row, await asyncio.shield(carried_structure.carry(context.analyses, plain, row.path)), warnings


async def _read_samples(context: Context) -> None:
    """Store a digest of the samples of each recording that has none yet: those of the rig, and joined ones."""
    rows = await asyncio.to_thread(context.store.all, Recording, Recording.samples_sha256.is_(None))
    for first in range(0, len(rows), AT_ONCE):
        some = rows[first : first + AT_ONCE]
        answer = await context.pool.submit("samples", paths=[row.path for row in some]).result

        def store(some: Sequence[Recording] = some, digests: Sequence[str] = answer["digests"]) -> None:
            with context.store.write() as session:
                for row, digest in zip(some, digests, strict=True):
                    session.execute(update(Recording).where(Recording.id == row.id).values(samples_sha256=digest))

        await asyncio.to_thread(store)


def _other_owner(context: Context, new: Recording, principal: Principal, stated_owner: str, of: str) -> str:
    """Return the other participant that the recording belongs to, as confirmed with `of`; empty: none.

    Raises ApiError: 409 the file or the database names another participant, and that is not confirmed.
    """
    code, why, owner = new.participant, "The file says that it is a recording of", stated_owner
    if not owner:
        same = Recording.file_sha256 == new.file_sha256
        if new.samples_sha256:
            same = or_(same, Recording.samples_sha256 == new.samples_sha256)
        why = "The same samples are stored as a recording of"
        owner = next(iter(context.store.all(Recording.participant, same, order=Recording.created_utc)), code)
    if owner == code or (owner == of and principal.may(Scope.APPROVE_MODEL)):
        return "" if owner == code else owner
    detail = (
        f"{why} {owner}, not of {code}. Nothing of it was kept. Who may approve models can take it for {code} all the "
        f"same: send it again with of={owner}."
    )
    title, more = "This is another participant's recording", {}
    if principal.may(Scope.APPROVE_MODEL):
        button = f"Take the recording of {owner} for {code}"
        more = {"confirm": {"title": title, "button": button, "rows": [], "warnings": [detail], "token": owner}}
    raise ApiError(409, "other-participant", title, detail, of=owner, **more)


@contextlib.contextmanager
def _about_the_upload(path: Path) -> Iterator[None]:
    """Reword errors so that they are about the upload and reveal no path of this machine."""
    try:
        yield
    except ApiError as error:
        if error.code == "worker-died":
            error.detail = f"{error.detail.partition('. ')[0].rstrip('.')}. Nothing of the upload was kept."
            if error.status == 500:  # it crashed by itself
                raise ApiError(422, "data", "The upload cannot be read", error.detail) from error
        error.detail = error.detail.replace(str(path), "the upload").replace(path.name, "the upload")
        if "place" in error.extra:
            error.extra["place"] = error.extra["place"].replace(str(path), "the upload")
        raise


def _store(context: Context, row: Recording, by: str, of: str, tags: Tags, current_ma: float | None) -> Recording:
    row.created_utc = now = context.clock.utc()
    detail = {"participant": row.participant, "sha256": row.file_sha256, **({"of": of} if of else {})}
    with uploads.taken_in(Path(row.path)), context.store.write() as session:
        participant = participants.within(session, row.participant)
        locking.check(session, participant, tags)
        row.site = [*site_of(participant), current_ma]
        session.add(row)
        session.flush()
        audit.write(session, now, by, "upload recording", row.id, **detail)
    return row

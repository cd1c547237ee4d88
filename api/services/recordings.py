"""Recordings: their files, and recordings of other tools taken in."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import secrets
from collections.abc import Iterator, Sequence
from pathlib import Path

from stimrig.api.errors import ApiError, require_found
from stimrig.api.models import carried_structure
from stimrig.api.models.places import site_of
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.store import audit, locking, uploads
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Model, Recording
from stimrig.identify.records import HDF5_MAGIC, PARQUET_MAGIC


def find(context: Context, recording_id: str) -> tuple[Recording, Path]:
    """Return a recording and its file. Raises ApiError: 404 no such recording; 410 its file is gone."""
    row = context.store.get(Recording, recording_id)
    require_found(row, "recording", recording_id, "A test's document names its recording.")
    path = Path(row.path)
    if not path.is_file():
        detail = f"The file of recording {recording_id!r} is not in its place ({path.name}). Restore it from a backup."
        raise ApiError(410, "recording-gone", "The recording's file is missing", detail)
    return row, path


async def take_in(
    context: Context,
    code: str,
    data: bytes,
    principal: Principal,
    tags: Tags,
    columns: Sequence[str] = (),
    of: str = "",
) -> tuple[Recording, Model, list[str]]:
    """Keep a recording of another tool and identify a model from it; what was assumed.

    Where `columns` are mapped, what is kept is the record as a CSV file of ours, with the SHA-256 of what was sent.

    Raises ApiError: 422 it cannot be read or fitted; 409 it is another participant's than `of` says. Nothing is kept of
    it.
    """
    whole = await asyncio.to_thread(_write, context, data, ".csv" if columns else _suffix(data))
    part = uploads.part_of(whole)
    try:
        assumed, data = await _rename_columns(context, part, columns, data)
        with _about_the_upload(part):
            fitted = await context.analyses.run("fit", data=str(part))
        of = await asyncio.to_thread(_other_owner, context, code, principal, fitted.get("of") or "", data, of)
    except BaseException:  # refused, or nobody waits for it any more
        part.unlink(missing_ok=True)
        raise
    warnings = [note for note in (*assumed, *fitted["notes"]) if note]
    row = await asyncio.shield(
        asyncio.to_thread(_store, context, code, whole, data, principal.name, warnings, of, tags)
    )
    plain = await asyncio.to_thread(context.versions.add, fitted["json"], code, row.id, principal.name)
    return row, await asyncio.shield(carried_structure.carry(context.analyses, plain, row.path)), warnings


def _other_owner(context: Context, code: str, principal: Principal, stated_owner: str, data: bytes, of: str) -> str:
    """Return the other participant that the recording belongs to, as confirmed with `of`; empty: none.

    Raises ApiError: 409 the file or the database names another participant, and that is not confirmed.
    """
    same = Recording.file_sha256 == hashlib.sha256(data).hexdigest()
    owner = stated_owner or next(
        iter(context.store.all(Recording.participant, same, order=Recording.created_utc)), code
    )
    if owner == code or (owner == of and principal.may(Scope.APPROVE_MODEL)):
        return "" if owner == code else owner
    detail = (
        f"The file says that it is a recording of {owner}, not of {code}. Nothing of it was kept. Who may approve "
        f"models can take it for {code} all the same: send it again with of={owner}."
    )
    title, more = "This is another participant's recording", {}
    if principal.may(Scope.APPROVE_MODEL):
        button = f"Take the recording of {owner} for {code}"
        more = {"confirm": {"title": title, "button": button, "rows": [], "warnings": [detail], "token": owner}}
    raise ApiError(409, "other-participant", title, detail, of=owner, **more)


async def _rename_columns(context: Context, path: Path, columns: Sequence[str], data: bytes) -> tuple[list[str], bytes]:
    """Return what was assumed, and the bytes to keep: the upload, or the CSV table converted from it."""
    if not columns:
        return [], data
    out = path.with_suffix(uploads.PLAIN)
    try:
        with _about_the_upload(path):
            table = await context.pool.submit("plain_csv", data=str(path), out=str(out), columns=list(columns)).result
        await asyncio.to_thread(out.replace, path)
    finally:
        out.unlink(missing_ok=True)
    return table["notes"], await asyncio.to_thread(path.read_bytes)


@contextlib.contextmanager
def _about_the_upload(path: Path) -> Iterator[None]:
    """Reword errors so that they are about the upload and reveal no path of this machine."""
    try:
        yield
    except ApiError as error:
        if error.code == "worker-died":
            detail = f"{error.detail.partition('. ')[0]}. Is the file damaged? Nothing of it was kept."
            raise ApiError(422, "data", "The upload cannot be read", detail) from error
        error.detail = error.detail.replace(str(path), "the upload").replace(path.name, "the upload")
        if "place" in error.extra:
            error.extra["place"] = error.extra["place"].replace(str(path), "the upload")
        raise


def _suffix(data: bytes) -> str:
    kinds = {HDF5_MAGIC: ".h5", b"MATLAB ": ".mat", PARQUET_MAGIC: ".parquet"}
    return next((suffix for magic, suffix in kinds.items() if data.startswith(magic)), ".csv")


def _write(context: Context, data: bytes, suffix: str) -> Path:
    path = context.settings.recordings_dir / f"{uploads.PREFIX}{secrets.token_hex(8)}{suffix}"
    uploads.part_of(path).write_bytes(data)
    return path


def _store(
    context: Context, code: str, path: Path, data: bytes, by: str, warnings: list[str], of: str, tags: Tags
) -> Recording:
    now = context.clock.utc()
    row = Recording(id=path.stem, participant=code, test_id=None, path=str(path), origin="upload", created_utc=now)
    row.file_sha256 = hashlib.sha256(data).hexdigest()
    row.warnings = warnings
    detail = {"participant": code, "sha256": row.file_sha256, **({"of": of} if of else {})}
    with uploads.taken_in(path), context.store.write() as session:
        participant = participants.within(session, code)
        locking.check(session, participant, tags)
        row.site = list(site_of(participant))
        session.add(row)
        session.flush()
        audit.write(session, now, by, "upload recording", row.id, **detail)
    return row

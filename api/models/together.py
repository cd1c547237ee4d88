"""One model of several recordings of a muscle: isometric ones and those in which the joint was held or moved."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Sequence
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError, require_found
from stimrig.api.models.analyses import Analyses, OnCall
from stimrig.api.models.places import Site, site_of_recording
from stimrig.api.store import audit, uploads
from stimrig.api.store.tables import Model, Recording, Test

JOINT_EFFECTS = ("passive_torque:surface|relaxing", "torque_angle:smooth", "torque_velocity:surface")
"""What the torque does with angle and velocity, as `identify.fitting.MOVING_JOINT` (the web process loads no numpy):
fitted where nothing else is asked for."""
MOST = 20
ANGLE = "angle_rad"


async def fit(
    analyses: Analyses, participant: str, recordings: Sequence[str], effects: Sequence[str], by: str,
    on_call: OnCall | None = None,
) -> Model:  # fmt: skip
    """Join the recordings and fit them as one.

    Parameters
    ----------
    recordings : sequence of str
        Ids, each once; a single one is fitted as it is.
    effects : sequence of str
        Of the model.

    Raises
    ------
    ApiError
        404: no such recording; 422: of another participant, named twice, without the joint's angle although an effect
        needs it, or the data do not allow the fit.
    """
    rows = await asyncio.to_thread(_find_recordings, analyses, participant, recordings)
    ids = _ids(effects)
    await analyses.check_known(ids)
    needs = [ANGLE] if {*ids} & {*_ids(JOINT_EFFECTS)} else []
    whole = rows[0] if len(rows) == 1 else await _joined(analyses, rows, participant, needs)
    found = await analyses.run("fit", on_call, data=whole.path, effects=list(effects))
    return await asyncio.to_thread(_store, analyses, found["json"], participant, whole, by, recordings)


def _ids(effects: Sequence[str]) -> list[str]:
    """Of effects that may say their forms, too."""
    return [name.partition(":")[0] for name in effects]


def _find_recordings(analyses: Analyses, participant: str, recordings: Sequence[str]) -> list[Recording]:
    rows = []
    for identity in recordings:
        fix = "GET /v1/participants/{code}/tests names those of its tests."
        row = require_found(analyses.store.get(Recording, identity), "recording", identity, fix)
        if row.participant != participant:
            detail = f"{identity} is a recording of {row.participant}, the model is to be one of {participant}."
            raise ApiError(422, "other-participant", "The recording is another participant's", detail)
        rows.append(row)
    return rows


async def _joined(analyses: Analyses, rows: list[Recording], participant: str, needs: list[str]) -> Recording:
    """The recordings as one; where one of them does not do, it is named by its id and not by its number."""
    try:
        return await join(analyses, [row.id for row in rows], participant, needs)
    except ApiError as error:
        for number, row in enumerate(rows, start=1):
            if str(error.extra.get("place", "")) == f"recording {number}":
                error.detail = error.detail.replace(f"recording {number}", f"recording {row.id}", 1)
                error.extra["place"] = f"recording {row.id}"
                break
        raise


def _store(
    analyses: Analyses, model_json: str, participant: str, whole: Recording, by: str, parts: Sequence[str]
) -> Model:
    row = analyses.versions.add(model_json, participant, whole.id, by)
    with analyses.store.write() as session:
        audit.write(session, analyses.clock.utc(), by, "fit recordings together", row.id, recordings=list(parts))
    return row


async def join(analyses: Analyses, parts: Sequence[str], participant: str, needs: Sequence[str] = ()) -> Recording:
    """Recordings as one, itself a recording (`origin` joined), to which all else applies.

    `parts`: their ids; where all begins are known the order is that of time. `needs`: columns that each of them must
    have, such as `angle_rad`; one that a part lacks is left out of the whole.
    """
    paths = [await asyncio.to_thread(analyses.path, part) for part in parts]
    settings = analyses.settings
    made = settings.exports_dir / f"{uploads.JOINED}{secrets.token_hex(8)}.csv"  # all that a worker may write to
    kept = settings.recordings_dir / made.name
    try:
        found = await analyses.run("join", urgent=True, parts=paths, out=str(made), needs=list(needs))
        await asyncio.to_thread(made.replace, uploads.part_of(kept))
    except BaseException:
        made.unlink(missing_ok=True)
        raise
    stored = asyncio.to_thread(_store_joined, analyses, kept, found["file_sha256"], participant, list(parts))
    return await asyncio.shield(stored)


def _one_site(session: Session, parts: list[str]) -> Site | None:
    """Where all parts stimulated; 409 where that was not one site."""
    tests = {test.recording_id: test for test in session.scalars(select(Test).where(Test.recording_id.in_(parts)))}
    rows = session.scalars(select(Recording).where(Recording.id.in_(parts)))
    sites = [site_of_recording(row, tests.get(row.id)) for row in rows]
    if any(site != sites[0] for site in sites):
        detail = "The recordings were made at different sites; what was learnt at one says nothing of another."
        raise ApiError(409, "other-site", "These recordings are of several sites", detail)
    return sites[0]


def warnings(session: Session, recording_id: str) -> list[str]:
    """What was found doubtful about a recording, in sentences: by the rig, or when its first model was made."""
    recording = session.get(Recording, recording_id)
    test = session.get(Test, recording.test_id) if recording is not None and recording.test_id else None
    found = test.summary.get("warnings") if test is not None else recording and recording.warnings
    return list(found or [])


def _store_joined(analyses: Analyses, kept: Path, digest: str, participant: str, parts: list[str]) -> Recording:
    now, identity = analyses.clock.utc(), kept.stem
    row = Recording(id=identity, participant=participant, path=str(kept), file_sha256=digest, origin="joined")
    row.test_id, row.created_utc = None, now
    with uploads.taken_in(kept), analyses.store.write() as session:
        site = _one_site(session, parts)
        row.site = None if site is None else list(site)
        row.warnings = list(dict.fromkeys(text for part in parts for text in warnings(session, part))) or None
        session.add(row)
        session.flush()
        audit.write(session, now, "service", "join recordings", identity, parts=parts, sha256=digest)
    return row

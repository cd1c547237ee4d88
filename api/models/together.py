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
from stimrig.api.models.places import current_of_recording, site_of_recording
from stimrig.api.store import audit, uploads
from stimrig.api.store.tables import Model, Recording, Test

JOINT_EFFECTS = ("passive_torque:surface|relaxing", "torque_angle:smooth", "torque_velocity:surface")
"""Effects of angle and velocity that are fitted where nothing else is asked for, as `identify.fitting.MOVING_JOINT`,
which the web process does not load."""
MAX_RECORDINGS = 20
ANGLE = "angle_rad"


async def fit(
    analyses: Analyses, participant: str, recordings: Sequence[str], effects: Sequence[str], by: str,
    on_call: OnCall | None = None,
) -> Model:  # fmt: skip
    """Join the recordings, each named once, and fit them as one; a single one is fitted as it is.

    Raises ApiError: 404 no such recording; 422 of another participant, without the joint's angle although an effect
    needs it, or the data do not allow the fit.
    """
    rows = []
    for name in recordings:
        fix = "GET /v1/tests?participant={code} names those of its tests."
        row: Recording | None = await asyncio.to_thread(analyses.store.get, Recording, name)
        rows.append(row := require_found(row, "recording", name, fix))
        if row.participant != participant:
            detail = f"{name} is a recording of {row.participant}, the model is to be one of {participant}."
            raise ApiError(422, "other-participant", "The recording is another participant's", detail)
    ids, of_joint = ([name.partition(":")[0] for name in names] for names in (effects, JOINT_EFFECTS))
    await analyses.check_known(ids)
    needs = [ANGLE] if {*ids} & {*of_joint} else []
    whole = rows[0] if len(rows) == 1 else await join(analyses, recordings, participant, needs)
    fitted = await analyses.run("fit", on_call, data=whole.path, effects=list(effects))

    def store() -> Model:
        row = analyses.versions.add(fitted["json"], participant, whole.id, by)
        analyses.store.note(analyses.clock, by, "fit recordings together", row.id, recordings=list(recordings))
        return row

    return await asyncio.to_thread(store)


async def join(analyses: Analyses, parts: Sequence[str], participant: str, needs: Sequence[str] = ()) -> Recording:
    """Join recordings to one, itself a recording (`origin` joined), to which all else applies.

    `parts`: their ids; where all begins are known the order is that of time. `needs`: columns that each of them must
    have, such as `angle_rad`; one that a part lacks is left out of the whole. A part that does not do is named by its
    id.
    """
    paths = [await asyncio.to_thread(analyses.path, part) for part in parts]
    # the only folder that a worker may write to
    export = analyses.settings.exports_dir / f"{uploads.JOINED}{secrets.token_hex(8)}.csv"
    path = analyses.settings.recordings_dir / export.name
    try:
        joined = await analyses.run("join", urgent=True, parts=paths, out=str(export), needs=list(needs))
        await asyncio.to_thread(export.replace, uploads.part_of(path))
    except BaseException as error:
        export.unlink(missing_ok=True)
        if isinstance(error, ApiError):
            place, _, number = str(error.extra.get("place", "")).partition("recording ")
            if not place and number.isdecimal():
                error.extra["place"] = f"recording {parts[int(number) - 1]}"
                error.detail = error.detail.replace(f"recording {number}", error.extra["place"], 1)
        raise
    stored = asyncio.to_thread(_store_joined, analyses, path, joined["file_sha256"], participant, list(parts))
    return await asyncio.shield(stored)


def _store_joined(analyses: Analyses, path: Path, digest: str, participant: str, parts: list[str]) -> Recording:
    now = analyses.clock.utc()
    row = Recording(
        id=path.stem, participant=participant, path=str(path), file_sha256=digest, origin="joined", created_utc=now
    )
    with uploads.taken_in(path), analyses.store.write() as session:
        tests = {test.recording_id: test for test in session.scalars(select(Test).where(Test.recording_id.in_(parts)))}
        rows = session.scalars(select(Recording).where(Recording.id.in_(parts))).all()
        site, *others = (site_of_recording(part, tests.get(part.id)) for part in rows)
        if any(other != site for other in others):
            detail = "The recordings were made at different sites; what was learnt at one says nothing of another."
            raise ApiError(409, "other-site", "These recordings are of several sites", detail)
        currents_ma = {current_of_recording(part, tests.get(part.id)) for part in rows}
        row.site = None if site is None else [*site, currents_ma.pop() if len(currents_ma) == 1 else None]
        row.warnings = list(dict.fromkeys(text for part in parts for text in warnings(session, part))) or None
        session.add(row)
        session.flush()
        audit.write(session, now, "service", "join recordings", row.id, parts=parts, sha256=digest)
    return row


def warnings(session: Session, recording_id: str) -> list[str]:
    """Return the warnings about a recording, from the rig or from its upload."""
    recording = session.get(Recording, recording_id)
    test = session.get(Test, recording.test_id) if recording is not None and recording.test_id else None
    sentences = test.summary.get("warnings") if test is not None else recording and recording.warnings
    return list(sentences or [])

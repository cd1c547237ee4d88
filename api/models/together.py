"""One model of several recordings of a muscle: isometric ones and those in which the joint was held or moved."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.models.analyses import Analyses, OnCall
from stimrig.api.store import audit
from stimrig.api.store.tables import Model, Recording

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
    rows = await asyncio.to_thread(_found, analyses, participant, recordings)
    ids = _ids(effects)
    await analyses.check_known(ids)
    needs = [ANGLE] if {*ids} & {*_ids(JOINT_EFFECTS)} else []
    whole = rows[0] if len(rows) == 1 else await _joined(analyses, rows, participant, needs)
    found = await analyses.asked("fit", on_call, data=whole.path, effects=list(effects))
    return await asyncio.to_thread(_store, analyses, found["json"], participant, whole, by, recordings)


def _ids(effects: Sequence[str]) -> list[str]:
    """Of effects that may say their forms, too."""
    return [name.partition(":")[0] for name in effects]


def _found(analyses: Analyses, participant: str, recordings: Sequence[str]) -> list[Recording]:
    rows = []
    for identity in recordings:
        row: Recording | None = analyses.store.get(Recording, identity)
        if row is None:
            raise NotFoundError("recording", identity, "GET /v1/participants/{code}/tests names those of its tests.")
        if row.participant != participant:
            detail = f"{identity} is a recording of {row.participant}, the model is to be one of {participant}."
            raise ApiError(422, "other-participant", "The recording is another participant's", detail)
        rows.append(row)
    return rows


async def _joined(analyses: Analyses, rows: list[Recording], participant: str, needs: list[str]) -> Recording:
    """The recordings as one; where one of them does not do, it is named by its id and not by its number."""
    try:
        return await analyses.join([row.id for row in rows], participant, needs)
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

"""Fits a new recording with the structure of the participant's last approved model.

It is fitted beside the plain structure, and the better of the two is offered. A participant without an approved model
begins with the effects that the site has set.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.worker import Worker
from stimrig.api.models import stored_model
from stimrig.api.models.analyses import Analyses, OnCall
from stimrig.api.settings import Settings
from stimrig.api.store.tables import Model
from stimrig.api.structure import in_words


async def fit(
    analyses: Analyses, participant: str, path: str, on_call: OnCall | None = None, **how: Any
) -> tuple[dict[str, Any], str]:
    """Fit the first model of a recording; also returns what had to be left out of its structure, empty for nothing.

    It is plain where a structure is carried over after it, and where nothing in the recording looks like an effect of
    the site's: a test that a person went through gives a model.

    Raises ApiError: the recording gives no model in the plain structure either.
    """
    earlier = await asyncio.to_thread(analyses.versions.last_approved, participant)
    effects, warning = list(analyses.settings.structure) if earlier is None else [], ""
    if effects:
        try:
            return await analyses.run("fit", on_call, data=path, effects=effects, **how), ""
        except ApiError as error:
            if error.code != "data":
                raise
            names = in_words(effects).replace("_", " ")
            warning = f"Fitted in the plain structure, not with {names}: {error.detail}"
    return await analyses.run("fit", on_call, data=path, **how), warning


async def carry(analyses: Analyses, plain: Model, path: str, on_call: OnCall | None = None, **how: Any) -> Model:
    """Return the version that is offered: the plain one, or its child in the structure of the last approved model.

    Whatever becomes of the carried structure, the plain model stays; what was found is kept with it, and with the
    child.
    """
    versions = analyses.versions
    earlier = await asyncio.to_thread(versions.last_approved, plain.participant)
    if earlier is None or earlier.recording_id == plain.recording_id or plain.effects:
        return plain
    try:
        carried = await analyses.run("carry", on_call, data=path, model_json=stored_model.text(earlier), **how)
    except (ApiError, OSError, ValueError) as error:  # every error of a worker's call
        why, said = (error.code, f"{error.title}. {error.detail}") if isinstance(error, ApiError) else ("failed", error)
        found: dict[str, Any] = {key: [] for key in ("still_needed", "no_longer_needed", "undecided", "effects")}
        reason = f"The structure of the last session was not fitted. {said}".strip()
        carried = {"json": None, "found": {**found, "offered": "plain", "why": why, "reason": reason}}
    finding = {key: value for key, value in carried["found"].items() if key != "carried_from"}
    finding["from_model_id"] = earlier.id

    def store() -> Model:
        with versions.store.write() as session:
            row = session.get_one(Model, plain.id)
            row.carried = finding
            row.carried_from_id = earlier.id if finding["why"] == "plain-before" else None
        if carried["json"] is None:
            return row
        document = json.loads(carried["json"])
        document["extra"] = {**(document.get("extra") or {}), "parent": plain.id}
        child = versions.add(
            json.dumps(document), plain.participant, plain.recording_id, plain.created_by, plain.id,
            ",".join(effect["id"] for effect in document["effects"]), carried_from_id=earlier.id, carried=finding,
        )  # fmt: skip
        return child if finding["offered"] == "carried" else row

    return await asyncio.to_thread(store)


async def refuse_unknown(settings: Settings, worker: Callable[..., Worker] = Worker) -> None:
    """Refuse effects of the site's own that cannot be used, and a structure that names what is not in the library.

    A worker reads the library.

    Raises OSError: which, and what there is; or why the library cannot be read.
    """
    if not settings.structure and not settings.effects_dir:
        return
    pool = Pool(1, worker)
    try:
        library = await pool.submit("effects").result
    except ApiError as error:
        raise OSError(f"the library of effects cannot be read: {error}") from error
    finally:
        await pool.close()
    known = sorted(entry["id"] for entry in library["effects"])
    unknown = [effect for effect in settings.structure if effect not in known]
    if unknown:
        raise OSError(f"STIMRIG_STRUCTURE: no effect is called {', '.join(unknown)}. Take some of {', '.join(known)}.")

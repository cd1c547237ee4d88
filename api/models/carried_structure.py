"""Fits a new recording with the structure of the participant's last approved model.

It is fitted beside the plain structure, and the better of the two is offered.
"""

from __future__ import annotations

import asyncio
import json
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.models import stored_model
from stimrig.api.models.analyses import Analyses, OnCall
from stimrig.api.store.tables import Model


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
        carried: dict[str, Any] = await analyses.run(
            "carry", on_call, data=path, model_json=stored_model.text(earlier), **how
        )
    except (ApiError, OSError, ValueError) as error:  # every error of a worker's call
        why, words = (
            (error.code, f"{error.title}. {error.detail}") if isinstance(error, ApiError) else ("failed", error)
        )
        nothing: dict[str, Any] = {key: [] for key in ("still_needed", "no_longer_needed", "undecided", "effects")}
        reason = f"The structure of the last session was not fitted. {words}".strip()
        carried = {"json": None, "found": {**nothing, "offered": "plain", "why": why, "reason": reason}}
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

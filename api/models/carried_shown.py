"""What the model page shows of a structure that was carried over from the participant's last approved model."""

from __future__ import annotations

from typing import Any

from api.models.explanation import name_of
from api.models.registry import Versions
from api.store.tables import Model


def shown(versions: Versions, row: Model, diagnosis: dict[str, Any] | None) -> dict[str, Any] | None:
    """What `carried.html` holds; None for a version whose recording was asked nothing of the kind.

    Parameters
    ----------
    versions : Versions
        Where the earlier model and the other version of this recording are found.
    row : Model
        The version that the page shows: the plain one, or its child in the carried structure.
    diagnosis : dict or None
        What is missing in this version; None as long as it is being found out.

    Returns
    -------
    dict or None
        `earlier` (id and time); `kept`, `dropped` and `undecided` (effects with their reasons); `new` (names; None as
        long as there is no diagnosis) and `again` (names of those left out that the diagnosis asks for); `offered`
        (this version is the one), `better` (the carried one is), `is_plain`, `other` (id of the other version),
        `reason`.
    """
    found = row.carried
    if found is None or found["why"] == "plain-before":
        return None
    carried = row.carried_from_id is not None
    earlier = versions.get(found["from_model_id"])
    missing = None if diagnosis is None else diagnosis["missing"]
    known = [effect["effect"] for effect in found["effects"]]
    again = {entry["effect"] for entry in missing or []} & {*found["no_longer_needed"], *found["undecided"]}
    left = [effect for effect in found["effects"] if effect["effect"] not in again]
    return {
        "earlier": {"id": earlier.id, "created_utc": earlier.created_utc},
        "kept": [effect for effect in found["effects"] if effect["needed"]],
        "dropped": [effect for effect in left if effect["needed"] is False],
        "undecided": [effect for effect in left if effect["needed"] is None],
        "new": None if missing is None else [_name(entry) for entry in missing if entry["effect"] not in known],
        "again": [effect["name"] for effect in found["effects"] if effect["effect"] in again],
        "offered": carried == (found["offered"] == "carried"),
        "other": _other(versions, row, carried),
        "better": found["offered"] == "carried",
        "is_plain": not carried,
        "reason": found["reason"],
    }


def _name(entry: dict[str, Any]) -> str:
    return name_of(entry["effect"], {entry["effect"]: entry})


def _other(versions: Versions, row: Model, carried: bool) -> str | None:
    """The plain version of a carried one; the carried one of a plain one, where there is one."""
    if carried:
        return row.parent_id
    below = [other for other in versions.lineage(row) if other.parent_id == row.id and other.carried_from_id]
    return below[0].id if below else None

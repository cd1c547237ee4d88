"""How a model was improved: where it failed at first, what was added, how the error fell, and why that ended."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from stimrig.api.effect_words import fact_of
from stimrig.api.models import explanation
from stimrig.api.models.explanation import place
from stimrig.identify.conclusion import why_ended
from stimrig.identify.healing import healed_places, place_words

SAME = 0.995
"""An error that is larger than this share of the one before has not fallen."""


def story(
    rows: Sequence[dict[str, Any]],
    before: dict[str, Any],
    after: dict[str, Any],
    diagnosis: dict[str, Any] | None,
    last: dict[str, Any] | None,
) -> dict[str, Any]:
    """What the page and the file of the story hold.

    `rows`: the versions on the way, as `explanation.versions` gives them; `before`, `after`: the first and the last
    model compared with the recording; `diagnosis`, `last`: those of the first model and of the last one.
    """
    error = "held_out_rms_nm" if rows[0]["held_out_rms_nm"] is not None else "rms_nm"
    fell = rows[-1][error] < SAME * rows[0][error]
    why = diagnosis and explanation.view(diagnosis, before, [])
    healed = healed_places(before, after) if why is None or why["places"] else []
    places = [
        {**place(found, number), **found, "became": place_words(found)} for number, found in enumerate(healed, start=1)
    ]
    return {
        "title": _title(rows, error, fell),
        "fell": fell,
        "error": error,
        "rows": rows,
        "places": places,
        "why": why,
        "steps": [_step(row, previous, error) for previous, row in pairwise(rows)],
        "ended": last and why_ended(last),
        "then": last and explanation.view(last, after, rows[-1].get("effects") or []),
        "noise_sd_nm": after.get("noise_sd_nm"),
    }


def _title(rows: Sequence[dict[str, Any]], error: str, fell: bool) -> str:
    first, now = (f"{row[error]:.3g}" for row in (rows[0], rows[-1]))
    held_out = error.startswith("held_out")
    if len(rows) == 1:
        return f"The held-out error is {now} N·m" if held_out else f"The error is {now} N·m"
    given = {"first": first, "now": now}
    if fell:
        falls = "The held-out error fell from {first} to {now} N·m".format(**given)
        return falls if held_out else "The error fell from {first} to {now} N·m".format(**given)
    stays = "The held-out error did not fall: {first}, then {now} N·m".format(**given)
    return stays if held_out else "The error did not fall: {first}, then {now} N·m".format(**given)


def _step(row: dict[str, Any], before: dict[str, Any], error: str) -> dict[str, Any]:
    """What a version added, in plain words, and what that did to the error."""
    added = (row.get("added_effect") or "").split(",")
    plain = " ".join(fact_of(effect, "plain", "") for effect in added)
    return {**row, "plain": plain, "before_nm": before[error], "after_nm": row[error]}

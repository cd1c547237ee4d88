"""How a model was improved: where it failed at first, what was added, how the error fell, and why that ended."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from stimrig.api.effect_words import fact_of
from stimrig.api.language import _, localised, translated
from stimrig.api.models import explanation
from stimrig.api.models.explanation import place
from stimrig.identify.conclusion import why_ended
from stimrig.identify.healing import healed_places, place_words


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
    why = diagnosis and explanation.view(diagnosis, before, [])
    healed = healed_places(before, after) if why is None or why["places"] else []
    places = [
        {**place(found, number), **found, "became": translated(place_words(found))}
        for number, found in enumerate(healed, start=1)
    ]
    return {
        "title": _title(rows),
        "rows": rows,
        "places": places,
        "why": why,
        "steps": [_step(row, previous) for previous, row in pairwise(rows)],
        "ended": last and translated(why_ended(last)),
        "then": last and explanation.view(last, after, rows[-1].get("effects") or []),
        "noise_sd_nm": after.get("noise_sd_nm"),
    }


def _title(rows: Sequence[dict[str, Any]]) -> str:
    held_out = rows[0]["held_out_rms_nm"] is not None
    error = "held_out_rms_nm" if held_out else "rms_nm"
    first, now = (localised(f"{row[error]:.3g}") for row in (rows[0], rows[-1]))
    if len(rows) > 1:
        if held_out:
            return _("The held-out error fell from %(first)s to %(now)s N·m", first=first, now=now)
        return _("The error fell from %(first)s to %(now)s N·m", first=first, now=now)
    return _("The held-out error is %(now)s N·m", now=now) if held_out else _("The error is %(now)s N·m", now=now)


def _step(row: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """What a version added, in plain words, and what that did to the error."""
    added = (row.get("added_effect") or "").split(",")
    plain = " ".join(translated(fact_of(effect, "plain", "")) for effect in added)
    return {**row, "plain": plain, "before_nm": before["held_out_rms_nm"], "before_fit_nm": before["rms_nm"]}

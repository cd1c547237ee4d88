"""Story of a model's improvement: where it failed first, what was added, how the error fell, and why it ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from stimrig.api.effect_words import fact_of
from stimrig.api.models import explanation
from stimrig.identify.conclusion import why_ended
from stimrig.identify.healing import healed_places, place_words

SAME = 0.995
"""An error above this share of the previous one counts as not reduced."""


def story(
    rows: Sequence[dict[str, Any]],
    before: Mapping[str, Any],
    after: Mapping[str, Any],
    diagnosis: Mapping[str, Any] | None,
    last: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Put together what the page and the file of the story show.

    `rows`: the versions on the way, as `explanation.versions` gives them; `before`, `after`: the first and the last
    model compared with the recording; `diagnosis`, `last`: those of the first model and of the last one.
    """
    error = "held_out_rms_nm" if rows[0]["held_out_rms_nm"] is not None else "rms_nm"
    first_nm, last_nm = rows[0][error], rows[-1][error]
    fell = last_nm < SAME * first_nm
    named = "held-out error" if error == "held_out_rms_nm" else "error"
    if len(rows) == 1:
        title = f"The {named} is {last_nm:.3g} N·m"
    elif fell:
        title = f"The {named} fell from {first_nm:.3g} to {last_nm:.3g} N·m"
    else:
        title = f"The {named} did not fall: {first_nm:.3g}, then {last_nm:.3g} N·m"
    why = diagnosis and explanation.view(diagnosis, before)
    healed = healed_places(before, after) if why is None or why["places"] else []
    return {
        "title": title,
        "fell": fell,
        "error": error,
        "rows": rows,
        "places": [
            {**explanation.place(each, number), "became": place_words(each)}
            for number, each in enumerate(healed, start=1)
        ],
        "why": why,
        "steps": [
            {
                **row,
                "plain": " ".join(fact_of(effect, "plain", "") for effect in (row["added_effect"] or "").split(",")),
                "before_nm": previous[error],
                "after_nm": row[error],
            }
            for previous, row in pairwise(rows)
        ],
        "ended": last and why_ended(last),
        "then": last and explanation.view(last, after),
        "noise_sd_nm": after.get("noise_sd_nm"),
    }

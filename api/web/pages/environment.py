"""The templates, and how texts, numbers and times are written in them: for pages and for reports as files."""

from __future__ import annotations

import math
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from stimrig.api import clinical_words, effect_words, local_time
from stimrig.api.models.changes import dose_words
from stimrig.api.models.places import Site, site_of
from stimrig.api.models.stored_model import followed
from stimrig.rig.messages import LABEL_TITLES

HERE = Path(__file__).parent

environment = Environment(
    loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    if value is None:
        return "–"
    text = f"{value:.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def figures(value: float | None) -> str:
    """A number to three significant figures, without powers of ten where they can be done without."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}" if digits <= 6 else f"{value:.2g}"
    return text.replace("-", "−")


def site_words(site: Site) -> str:
    """Write a site as a person says it: left, biceps brachii, A. Muscles keep their Latin names."""
    return ", ".join(part for part in site if part) or "not said"


environment.filters.update({
    "number": number, "followed": followed, "figures": figures, "when": local_time.when, "clock": local_time.clock,
    "day": local_time.day, "until": local_time.until,
    "words": clinical_words.words, "segment_words": clinical_words.segment_words, "degrees": clinical_words.degrees,
    "effect_words": effect_words.effect_words, "effects_words": effect_words.effects_words,
    "label_rows": clinical_words.label_rows, "dose": dose_words,
})  # fmt: skip
environment.policies["json.dumps_kwargs"] = {"sort_keys": True}
environment.globals |= {  # type: ignore
    "site_words": site_words,
    "site_of": site_of,
    "label_titles": LABEL_TITLES,
}

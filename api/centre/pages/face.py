"""What the centre's pages look like: the rigs' base, another bar, no stop button."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import Request
from jinja2 import ChoiceLoader, FileSystemLoader, PrefixLoader

from stimrig.api.centre import warnings
from stimrig.api.centre.pages import warning_words
from stimrig.api.people.auth import Principal
from stimrig.api.web.pages.environment import HERE, environment, in_its_language
from stimrig.api.web.pages.render import Face

WEB = FileSystemLoader(HERE / "templates")
own = environment.overlay(
    loader=ChoiceLoader([FileSystemLoader(Path(__file__).parent / "templates"), WEB, PrefixLoader({"rig": WEB})])
)
"""The centre's templates first; `rig/…` is the rigs' one of a name that both have."""
environment.filters["warning_title"] = in_its_language(warning_words.title)
environment.filters["warning_advice"] = in_its_language(warning_words.advice)


def bar(request: Request, _looking: Principal | None, principal: Principal | None) -> dict[str, Any]:
    """What every page has at its top."""
    waiting = request.app.state.context.waiting_warnings if principal is not None else 0
    return {"right": None, "current": None, "warnings": waiting, "most": warnings.MOST_OPEN}


FACE = Face(own, bar)

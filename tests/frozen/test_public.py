"""What is public stays, or was told of before it goes (docs/versions.md)."""

from __future__ import annotations

import asyncio
import tomllib
import warnings
from datetime import date

import httpx
import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

import stimrig
from stimrig import deprecations
from stimrig.api.cli import main
from stimrig.api.web.deprecated import Deprecated
from stimrig.deprecations import DEPRECATIONS, Deprecation
from tests.frozen import public

VERSION = tomllib.loads((public.KEPT.parents[2] / "pyproject.toml").read_text("utf-8"))["project"]["version"]
WAS: public.Public = {"verbs": {"fit": ["data!", "--method", "--effects"]}, "python": {"read": ["path!", "map"]}}


@pytest.mark.slow
def test_nothing_public_is_gone_or_changed_that_nobody_was_told_of() -> None:
    kept, now = public.kept(), public.public()
    assert public.broken(kept, now, DEPRECATIONS, VERSION) == [], "see docs/versions.md"
    assert public.new(kept, now) == [], "python -m tests.frozen public"


def test_every_deprecation_gives_notice_of_a_minor_version() -> None:
    assert public.unwarned(DEPRECATIONS, VERSION, public.kept()) == []
    told = [Deprecation("verbs/fit --method", "1.1", "1.1.3", "x"), Deprecation("nothing/fit", "1.0", "2.0", "x")]
    told += [Deprecation("routes/GET /v1/rig", "1.0", "2.0", "x"), Deprecation("python/read", "1.0", "1.1", "x")]
    found = public.unwarned(told, "1.1", WAS | {"routes": {}})
    words = ("a minor version's notice", "still in the list", "no such part", "headers", "still in the list")
    assert len(found) == len(words) and all(word in line for word, line in zip(words, found, strict=True)), found


@pytest.mark.parametrize(
    ("part", "name", "items", "line"),
    [
        ("verbs", "fit", ["data!", "--method"], "verbs/fit: --effects gone"),
        ("verbs", "fit", ["data!", "--method", "--effects!"], "verbs/fit: --effects must be given now"),
        ("verbs", "fit", ["data!", "--method", "--effects", "more!"], "verbs/fit: more is new and must be given"),
        ("python", "read", None, "python/read: gone"),
    ],
)
def test_a_change_that_breaks_is_found(part: str, name: str, items: list[str] | None, line: str) -> None:
    now = {place: dict(names) for place, names in WAS.items()}
    if items is None:
        del now[part][name]
    else:
        now[part][name] = items
    assert public.broken(WAS, now, [], "1.2") == [line]
    place = f"{part}/{name}" + (" " + line.split(": ")[1].split()[0] if items else "")
    assert public.broken(WAS, now, [Deprecation(place, "1.1", "1.2", "x")], "1.2") == [], "it was told of"
    assert public.broken(WAS, now, [Deprecation(place, "1.1", "1.3", "x")], "1.2") == [line], "too early"
    assert public.broken(WAS, now, [Deprecation(place, "1.2", "1.2", "x")], "1.2") == [line], "without notice"


def test_what_is_new_and_may_be_left_out_breaks_nothing() -> None:
    now = {"verbs": {"fit": [*WAS["verbs"]["fit"], "--more"], "fly": ["data!"]}, "python": WAS["python"]}
    assert public.broken(WAS, now, [], "1.1") == []
    assert public.new(WAS, now) == ["verbs/fit --more", "verbs/fly", "verbs/fly data!"]


# ---- how it is told


def told_of(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    dates = date(2027, 1, 1), date(2028, 1, 1)
    found = tuple(Deprecation(name, "1.1", "2.0", "something else", *dates) for name in names)
    monkeypatch.setattr(deprecations, "DEPRECATIONS", found)


def test_python_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    told_of(monkeypatch, "python/read")
    with pytest.warns(DeprecationWarning, match="read is deprecated since 1.1 and gone in 2.0; use something else"):
        _ = stimrig.read
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _ = stimrig.fit


def test_a_verb_and_an_option_say_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    told_of(monkeypatch, "verbs/schema", "verbs/fit --method")
    assert main.run(["schema"]) == 0
    printed = capsys.readouterr()
    assert printed.err == "stimrig: schema is deprecated since 1.1 and gone in 2.0; use something else\n"
    assert "deprecated" not in printed.out
    assert len(deprecations.of_command(["fit", "x.csv", "--method=narx"])) == 1
    assert deprecations.of_command(["compare", "--method", "fit"]) == []


def test_a_route_says_it_in_headers(monkeypatch: pytest.MonkeyPatch) -> None:
    told_of(monkeypatch, "routes/GET /v1/models/{model_id}/curves")
    routes = [Route(path, lambda _: PlainTextResponse("x")) for path in ("/v1/models/m1/curves", "/v1/models/m1")]
    app = Deprecated(Starlette(routes=routes))

    async def heads(path: str) -> httpx.Headers:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://x") as http:
            return (await http.get(path)).headers

    told = asyncio.run(heads("/v1/models/m1/curves"))
    assert told["deprecation"] == "@1798761600" and told["sunset"] == "Sat, 01 Jan 2028 00:00:00 GMT"
    assert "deprecation" not in asyncio.run(heads("/v1/models/m1"))

"""Forms of a page without a browser: found, and sent on the version that they show."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

import httpx


@dataclass
class Control:
    """A field or a button, with its attributes."""

    tag: str
    attributes: dict[str, str]

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    @property
    def disabled(self) -> bool:
        return "disabled" in self.attributes

    @property
    def kind(self) -> str:
        return self.attributes.get("type", "text")

    @property
    def value(self) -> Any:
        text, kind = self.attributes.get("value", ""), self.attributes.get("data-type")
        return text == "true" if kind == "flag" else float(text) if kind == "number" and text else text


@dataclass
class Form:
    """A form of a page: its attributes, fields and buttons."""

    attributes: dict[str, str]
    fields: list[Control] = field(default_factory=list)
    buttons: list[Control] = field(default_factory=list)

    def calls(self) -> list[tuple[str, dict[str, str], Control | None]]:
        """Return each way to send it: its `data-call`, the attributes that hold, and the button."""
        ways = [({**self.attributes, **(each.attributes if each else {})}, each) for each in self.buttons or [None]]
        return [(given["data-call"], given, button) for given, button in ways if "data-call" in given]


class Page(HTMLParser):
    """The forms of a page, and its CSRF token."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.forms: list[Form] = []
        self.meta = ""
        self._form: Form | None = None
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "meta" and given.get("name") == "csrf":
            self.meta = given["content"]
        elif tag == "form":
            self._form = Form(given)
            self.forms.append(self._form)
        elif tag in ("input", "select", "button") and self._form is not None and "form" not in given:
            (self._form.buttons if tag == "button" else self._form.fields).append(Control(tag, given))

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._form = None


def find(html: str, call: str) -> tuple[Form, dict[str, str], Control | None]:
    """Return the form, and the button, whose `data-call` begins or ends with this."""
    calls = [(form, given, button) for form in Page(html).forms for _, given, button in form.calls()]
    way = re.compile(rf"{re.escape(call)}.*|.*{re.escape(call)}(\?.*)?")
    return next(each for each in calls if way.fullmatch(each[1]["data-call"]))


def press(
    client: httpx.Client, page: str, call: str, *, html: str = "", confirm: str = "", **typed: Any
) -> httpx.Response:
    """Send the form of a page that makes this call, with its hidden fields; `html`: the page as it was shown before."""
    html = html or client.get(page, headers={"Accept": "text/html"}).text
    form, given, button = find(html, call)
    hidden = [each for each in form.fields if each.kind == "hidden" and each.value != ""] + ([button] if button else [])
    method, _, address = given["data-call"].partition(" ")
    headers = {"Accept": "application/json", "X-CSRF-Token": Page(html).meta}
    if version := given.get("data-if-match"):
        headers["If-Match"] = f'"{version}"'
    body = {each.name: each.value for each in hidden if each.name} | typed
    return client.request(method, address, params={"confirm": confirm} if confirm else {}, json=body, headers=headers)

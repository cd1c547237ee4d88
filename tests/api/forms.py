"""Forms of a page without a browser: found, read and sent as `act.js` does."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

import httpx

Text = str | tuple[str, ...]
"""What a person typed in a field, or in each field of one name."""
VOID = {"input", "br", "img", "link", "meta", "hr"}


@dataclass
class Control:
    """A field or a button, with its attributes; a list's value is the chosen option's."""

    tag: str
    attributes: dict[str, str]
    text: str = ""

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    @property
    def disabled(self) -> bool:
        return "disabled" in self.attributes

    @property
    def value(self) -> str:
        return self.attributes.get("value", self.text)

    @property
    def kind(self) -> str:
        return self.attributes.get("type", "text")


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
        self._open: list[Control] = []
        self._orphans: list[Control] = []
        self._form: Form | None = None
        self.feed(html)
        for control in self._orphans:
            for form in self.forms:
                if form.attributes.get("id") == control.attributes["form"]:
                    _add(form, control)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "meta" and given.get("name") == "csrf":
            self.meta = given["content"]
        elif tag == "form":
            self._form = Form(given)
            self.forms.append(self._form)
        elif tag == "option" and self._open and ("selected" in given or "value" not in self._open[-1].attributes):
            self._open[-1].attributes["value"] = given.get("value", "")
        elif tag in ("input", "select", "button"):
            control = Control(tag, given)
            self._open = [] if tag in VOID else [control]
            if "form" in given:
                self._orphans.append(control)
            elif self._form is not None:
                _add(self._form, control)

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._form = None
        if self._open and tag == self._open[-1].tag:
            self._open = []

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1].tag == "button":
            self._open[-1].text += data


def _add(form: Form, control: Control) -> None:
    (form.buttons if control.tag == "button" else form.fields).append(control)


def find(html: str, call: str) -> tuple[Form, dict[str, str], Control | None]:
    """Return the form, and the button, whose `data-call` begins or ends with this."""
    calls = [(form, given, button) for form in Page(html).forms for _, given, button in form.calls()]
    way = re.compile(rf"{re.escape(call)}.*|.*{re.escape(call)}(\?.*)?")
    return next(each for each in calls if way.fullmatch(each[1]["data-call"]))


def body_of(form: Form, button: Control | None, texts: dict[str, Text]) -> dict[str, Any]:
    """Return the body, as `act.js` makes it."""
    body: dict[str, Any] = {}
    groups: dict[str, list[Control]] = {}
    for control in [*form.fields, *([button] if button else [])]:
        skipped = {"data-confirm", "data-query", "disabled"} & set(control.attributes) or control.kind == "file"
        if control.name and not skipped and (control.kind != "checkbox" or "checked" in control.attributes):
            groups.setdefault(control.name, []).append(control)
    for name, controls in groups.items():
        given, (*_, types) = texts.get(name), [control.attributes.get("data-type", "").split() for control in controls]
        typed = list(given) if isinstance(given, tuple) else [c.value if given is None else given for c in controls]
        unchanged = all(a == b.value and b.kind != "hidden" for a, b in zip(typed, controls, strict=True))
        null = controls[-1].attributes.get("data-empty") == "null"
        if ("data-changed" in form.attributes and unchanged) or not (null or any(typed)):
            continue
        values: Any = [_value(text.strip(), types) for text in typed] if any(typed) else None
        *path, last = name.split(".")
        part = body
        for key in path:
            part = part.setdefault(key, {})
        part[last] = values if "list" in types or values is None else values[-1]
    return body


def _value(text: str, types: list[str]) -> Any:
    if "flag" in types:
        return text == "true"
    if not {"int", "number", "degrees"} & set(types):
        return text
    number = float(text.replace(",", ".").replace("−", "-"))
    return math.radians(number) if "degrees" in types else int(number) if "int" in types else number


def press(
    client: httpx.Client, page: str, call: str, *, html: str = "", confirm: str = "", **texts: Text
) -> httpx.Response:
    """Send the form of a page that makes this call; `html`: the page as it was shown before."""
    html = html or client.get(page, headers={"Accept": "text/html"}).text
    form, given, button = find(html, call)
    method, _, address = given["data-call"].partition(" ")
    headers = {"Accept": "application/json", "X-CSRF-Token": Page(html).meta}
    if version := given.get("data-if-match"):
        headers["If-Match"] = f'"{version}"'
    url = httpx.URL(address).copy_merge_params({"confirm": confirm} if confirm else {})
    return client.request(method, url, json=body_of(form, button, texts), headers=headers)

"""Forms of a page without a browser: found, read and sent as `act.js` does."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any
from urllib.parse import quote

import httpx

Text = str | tuple[str, ...] | None
"""What a person typed in a field, or in each field of one name; None: a box that is not ticked."""
VOID = {"input", "br", "img", "link", "meta", "hr"}


@dataclass
class Control:
    """A field or a button, with its attributes."""

    tag: str
    attributes: dict[str, str]
    text: str = ""
    options: list[tuple[str, bool]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    @property
    def disabled(self) -> bool:
        return "disabled" in self.attributes

    @property
    def value(self) -> str:
        if self.tag == "select":
            chosen = [value for value, selected in self.options if selected]
            return next(iter(chosen), self.options[0][0] if self.options else "")
        return self.attributes.get("value", "on" if self.kind in ("radio", "checkbox") else self.text)

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
        """Each way to send it: its `data-call`, the attributes that hold, and the button."""
        found = []
        for button in self.buttons or [None]:
            given = {**self.attributes, **(button.attributes if button else {})}
            if "data-call" in given:
                found.append((given["data-call"], given, button))
        return found

    def shown(self) -> dict[str, str]:
        """What stands in the fields that a person sees."""
        return {control.name: control.value for control in self.fields if control.kind != "hidden"}


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.forms: list[Form] = []
        self.by_id: dict[str, Form] = {}
        self.orphans: list[tuple[str, Control]] = []
        self.meta = ""
        self._form: Form | None = None
        self._open: Control | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "meta" and given.get("name") == "csrf":
            self.meta = given.get("content", "")
        if tag == "form":
            self._form = Form(given)
            self.forms.append(self._form)
            self.by_id[given.get("id", "")] = self._form
        if tag == "option" and self._open is not None:
            self._open.options.append((given.get("value", ""), "selected" in given))
        if tag in ("input", "select", "textarea", "button"):
            control = Control(tag, given)
            self._open = None if tag in VOID else control
            if "form" in given:
                self.orphans.append((given["form"], control))
            elif self._form is not None:
                _add(self._form, control)

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._form = None
        if self._open is not None and tag == self._open.tag:
            self._open = None

    def handle_data(self, data: str) -> None:
        if self._open is not None and self._open.tag != "select":
            self._open.text += data


def _add(form: Form, control: Control) -> None:
    (form.buttons if control.tag == "button" else form.fields).append(control)


def read(html: str) -> _Reader:
    """A page's forms."""
    reader = _Reader()
    reader.feed(html)
    for name, control in reader.orphans:
        if name in reader.by_id:
            _add(reader.by_id[name], control)
    return reader


def forms(html: str) -> list[Form]:
    return read(html).forms


def find(html: str, call: str) -> tuple[Form, dict[str, str], Control | None]:
    """The form, and the button, whose `data-call` begins or ends with this."""
    found = [
        (form, given, button)
        for form in forms(html)
        for each, given, button in form.calls()
        if each.partition("?")[0].endswith(call) or each.startswith(call)
    ]
    assert found, (call, [each for form in forms(html) for each, _, _ in form.calls()])
    return found[0]


def sent(form: Form, button: Control | None, texts: Mapping[str, Text]) -> dict[str, Any]:
    """The body, as `act.js` makes it."""
    body: dict[str, Any] = {}
    groups: dict[str, list[Control]] = {}
    for control in [*form.fields, *([button] if button and button.name else [])]:
        skipped = not control.name or control.disabled or control.kind == "file" or "data-confirm" in control.attributes
        flag = control.attributes.get("data-type") == "flag"
        ticked = "checked" in control.attributes if control.name not in texts else texts[control.name] is not None
        if control.kind == "radio" and control.name in texts:
            ticked = texts[control.name] == control.value
        if skipped or (control.kind in ("radio", "checkbox") and not ticked and not flag):
            continue
        groups.setdefault(control.name, []).append(control)
    for name, controls in groups.items():
        types = controls[0].attributes.get("data-type", "").split()
        given = [texts.get(name, control.value) for control in controls]
        typed = [str(text[place] if isinstance(text, tuple) else text).strip() for place, text in enumerate(given)]
        if "data-query" in controls[0].attributes:
            continue
        changed = any(
            text != control.value or control.kind == "hidden" for text, control in zip(typed, controls, strict=True)
        )
        if "data-changed" in form.attributes and not changed:
            continue
        if "flag" in types:
            ticked = [
                c.kind != "checkbox" or "checked" in c.attributes or texts.get(name) is not None for c in controls
            ]
            _put(body, name, ticked[-1] and typed[-1] in ("1", "true", "on"))
        elif not any(typed):
            if controls[0].attributes.get("data-empty") == "null":
                _put(body, name, None)
        elif types == ["list"]:
            _put(body, name, [part for text in typed for part in re.split(r"[\s,]+", text) if part])
        elif "list" in types:
            _put(body, name, [_value(text, types) for text in typed])
        else:
            _put(body, name, _value(typed[-1], types))
    return body


def _value(text: str, types: list[str]) -> Any:
    if "int" in types:
        return int(text)
    if "number" in types or "degrees" in types:
        number = float(text.replace(",", ".").replace("−", "-"))
        return math.radians(number) if "degrees" in types else number
    return text


def _put(body: dict[str, Any], name: str, value: Any) -> None:
    *path, last = name.split(".")
    for key in path:
        body = body.setdefault(key, {})
    body[last] = value


def press(
    client: httpx.Client, page: str, call: str, *, html: str = "", confirm: str = "", **texts: Text
) -> httpx.Response:
    """Send the form of a page that makes this call; `html`: the page as it was shown before."""
    html = html or client.get(page, headers={"Accept": "text/html"}).text
    form, given, button = find(html, call)
    method, _, address = given["data-call"].partition(" ")
    address = re.sub(r"\{(\w+)\}", lambda match: quote(str(texts.get(match[1], "")), safe=""), address)
    headers = {"Accept": "application/json", "X-CSRF-Token": read(html).meta}
    if version := given.get("data-if-match"):
        headers["If-Match"] = f'"{version}"'
    query = {"confirm": confirm} if confirm else {}
    url = httpx.URL(address, params={**dict(httpx.URL(address).params), **query})
    return client.request(method, url, json=sent(form, button, texts), headers=headers)

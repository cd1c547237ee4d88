"""Which messages the pages show: read from the templates and the source, merged into each catalogue.

``python -m stimrig.api.language.extract`` renews the catalogues (``fr`` as an argument begins one); ``--check`` changes
nothing and says what is missing.
"""

from __future__ import annotations

import ast
import io
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from babel import localedata
from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_file
from babel.messages.pofile import write_po

from stimrig.api.language import CODES, DEFAULT, HERE, catalogue, first

ROOT = HERE.parents[1]
KEYWORDS = {"_": None, "gettext": None, "ngettext": (1, 2), "lazy": None}
SENTENCES = (
    "identify/conclusion.py", "identify/healing.py", "identify/electrodes/search.py",
    "identify/errors.py", "identify/criticism/*.py", "identify/diagnosis/*.py",
    "identify/estimation/quality.py", "identify/effects/*.py", "identify/experiments/*.py", "identify/records/*.py",
    "identify/fitting.py", "identify/dynamics/grid.py", "identify/estimation/plain.py",
    "identify/estimation/candidates.py", "identify/estimation/effect_fit.py", "identify/estimation/samples.py",
    "identify/estimation/averaged.py", "identify/estimation/left_out.py", "identify/estimation/joint_sensor.py",
    "identify/methods/**/*.py", "identify/muscles/*.py", "identify/muscles/interplay/*.py", "identify/yardstick.py",
    "identify/simulation/joint_surface.py", "identify/simulation/predict.py",
    "rig/acquire/*.py", "rig/adapters/*.py", "rig/control/*.py", "rig/devices/*.py", "rig/assembly.py", "rig/gate.py",
    "rig/journal.py", "rig/limits.py", "rig/messages.py", "rig/plan.py", "rig/protocols.py", "rig/score.py",
    "rig/sequences/*.py", "rig/phase.py", "api/models/*.py", "api/people/*.py", "api/sessions/*.py",
    "api/store/seen.py", "api/web/*.py", "api/web/routes/*.py", "api/web/pages/*.py", "api/workers/*.py",
    "api/errors.py", "api/record_files.py",
)  # fmt: skip
"""Modules whose sentences reach a page without `_`, since what they make is stored, or answered in English."""
FOR_PROGRAMMERS = {
    "app.py", "erasure.py", "openapi.py", "dependencies.py", "server.py", "static.py", "operation.py",
    "own_file.py", "confinement.py", "child.py", "_can.py", "monitoring.py", "steps.py",
}  # fmt: skip
"""Modules of those folders whose texts no page shows."""
NAMED = {"Effect": ("name", "main"), "Interplay": ("name",), "Parameter": ("about",), "Field": ("title",)}
"""Calls with arguments (of a dictionary its values) that pages show although they may be a single word."""
NOT_SHOWN = {
    "NotAcceptedError",
    "SettingsError",
    "hold",
    "Field",
    "several",
    "Query",
    "describe_answer",
    "published",
    "problem",
    "spawn",
    "BadChunk",
    "inflated",
    "ngettext",
    "policy",
    "step",
    "WireError",
}
"""Calls whose texts no page shows: descriptions of the API, names of threads, what only a log says, plural forms."""

VOCABULARY = (
    # roles of people
    "administrator", "clinician", "engineer", "researcher", "controller", "reader",
    # states of a test
    "requested", "running", "sealing", "identifying", "completed", "stopped", "fault", "failed", "refused", "cancelled",
    # methods
    "maximum-likelihood", "two-stage", "ramp-deconvolution", "separable-least-squares", "narx", "plain",
    # tests of a residual
    "whiteness", "structure",
    # what aligned the clocks of stimulator and load cell
    "sync", "regression",
    # directions of a pulse width
    "rising", "falling", "held", "rising %(segment)s", "falling %(segment)s",
    # how sure, how much
    "very probably", "probably", "possibly", "something", "expired", "empty", "1 place", "%(count)s places",
    # what is joined
    "%(one)s and %(other)s", "%(one)s, then %(other)s", "“%(name)s”",
    "%(one)s from %(other)s", "%(name)s (%(form)s)", " by %(who)s", "with %(effects)s",
    # whom a person is like: as short as a sentence can be
    "Like %(name)s (%(percent)s %%).",
    # a sentence without the figure that `stimrig.api.structure.worded` takes away; made by `format`
    "%(test)s should separate %(those)s.", "%(test)s is the best test to separate %(those)s, but it may not be enough.",
    "pulse widths of %(range)s µs", "%(range)s pulses/s",
    # what was erased: the entries of the trail that say so
    "erase participant", "delete recordings",
    # what was not found, what ran
    "file", "job", "model", "participant", "recording", "schema", "test", "token", "user", "comparison", "diagnosis",
    "identification", "prediction",
    # what a worker does
    "tried %(effect)s", "comparing", "done", "loading", "predicting", "writing",
    # what a controller's trials tell
    "gain", "threshold", "time scale",
    # limits
    "rig file", "%(least)s to %(most)s µs",
    # where in a file
    "%(name)s, line %(line)s", "%(name)s, sample %(number)s", "%(name)s, pulse %(number)s",
    "%(name)s, attribute %(attribute)s", "attribute %(name)s",
    "element %(number)s", "recording %(number)s", "%(unit)s (or %(others)s)", "negative",
    # thresholds; states of the rig and of the stimulator
    "comfort", "motor", "sensory", "arming", "calibrating", "disconnected", "latched", "ready", "stopping", "uncertain",
    "not initialised", "low level initialised", "mid level initialised", "mid level running", "did not answer",
    # why and by whom the rig was stopped; what it answered
    "stop pressed on the page", "%(reason)s (by %(who)s)", "device: %(state)s",
)  # fmt: skip
"""Words that are stored or answered as they are, and translated where a page shows them (`|translated`); and what may
stand at a place of a sentence that is put together elsewhere (`f"No{more} effect of the library …"`)."""


def messages() -> Iterator[str | tuple[str, ...]]:
    """All messages of the source."""
    yield from VOCABULARY
    for path in sorted((ROOT / "api").rglob("*.html")):
        options = {"newstyle_gettext": "true", "trimmed": "true", "trim_blocks": "true", "lstrip_blocks": "true"}
        yield from _marked("jinja2.ext:babel_extract", path, options)
    for path in sorted((ROOT / "api").rglob("*.py")):
        yield from _marked("python", path, {})
    for pattern in SENTENCES:
        for path in (path for path in sorted(ROOT.glob(pattern)) if path.name not in FOR_PROGRAMMERS):
            yield from sentences(path.read_text(encoding="utf-8"))


def _marked(method: str, path: Path, options: dict[str, str]) -> Iterator[str | tuple[str, ...]]:
    for _, message, _, _ in extract_from_file(method, path, KEYWORDS, options=options):
        yield message


def sentences(source: str) -> Iterator[str]:
    """The sentences of a module: texts of more than a word that are no docstring and go to no log."""
    found = _Sentences()
    found.visit(ast.parse(source))
    yield from found.found


class _Sentences(ast.NodeVisitor):
    """Collects texts; an f-string becomes a message with named places."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        of = getattr(node.func, "value", None)
        owner = getattr(of, "id", getattr(of, "attr", "")).lstrip("_")  # `log`, `self.log` and `self._log` are one
        if name not in NOT_SHOWN and owner not in ("log", "re", "audit"):
            self.generic_visit(node)
        given = {part.arg: text for part in node.keywords if (text := _text(part.value))}
        named = [part.value for part in node.keywords if part.arg in NAMED.get(name, ())]
        self.found += [_text(one) for part in named for one in (part.values if isinstance(part, ast.Dict) else [part])]
        if name == "Effect" and "_" in given.get("id", ""):  # a page may find an effect by its id, or by that as words
            self.found += [given["id"], given["id"].replace("_", " ")]

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str) and _is_sentence(node.value):
            self.found.append(node.value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        message = pattern_of(node)
        if _is_sentence(re.sub(r"%\(\w+\)s", "", message)):
            self.found.append(message)
        for part in ast.walk(node):
            if isinstance(part, ast.IfExp):  # the words of `'low' if error > 0 else 'high'`
                self.found += [said for said in map(_text, (part.body, part.orelse)) if re.search("[A-Za-z]{2}", said)]


def _text(node: ast.expr) -> str:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def _is_sentence(text: str) -> bool:
    return bool(re.search(r"[A-Za-z]{2}.* .*[A-Za-z]{2}", text)) and not re.search(
        r"\n|^[/<]|charset=|default-src|\w = |{:|\w' =", text
    )


def pattern_of(node: ast.JoinedStr) -> str:
    """An f-string as a message: `f"{share:.0%} lower"` is ``%(share)s lower``."""
    used: set[str] = set()
    parts = []
    for part in node.values:
        if isinstance(part, ast.Constant):
            parts.append(str(part.value).replace("%", "%%"))
        elif isinstance(part, ast.FormattedValue):
            parts.append(f"%({_name(part.value, used)})s")
    return "".join(parts)


def _name(value: ast.expr, used: set[str]) -> str:
    known = getattr(value, "id", None) or getattr(value, "attr", None) or "value"
    name = next(n for k in range(1, 99) if (n := known if k == 1 else f"{known}_{k}") not in used)
    used.add(name)
    return name


def renewed(code: str) -> Catalog:
    """The catalogue of a language with today's messages; translations that are there stay, unused ones go."""
    begun = Catalog(locale=code, header_comment=f"# The pages in {code}; see docs/languages.md.")
    known = catalogue(code) if code in CODES else begun
    fresh = Catalog(locale=code, charset="utf-8", fuzzy=False, header_comment=known.header_comment)
    for message in messages():
        if message:
            old = known.get(first(message))
            fresh.add(message, old.string if old is not None and not old.fuzzy else "")
    fresh.creation_date = known.creation_date  # of the file: where no message changed, the file does not either
    return fresh


def missing(code: str) -> list[str]:
    """Messages that have no translation, and those that nothing shows any more (with a minus sign before them)."""
    fresh, known = renewed(code), catalogue(code)
    lacking = [str(entry.id) for entry in fresh if entry.id and not _has(entry.string)]
    gone = [f"- {entry.id}" for entry in known if entry.id and fresh.get(first(entry.id)) is None]
    return lacking + gone


def _has(translation: object) -> bool:
    return all(translation) if isinstance(translation, tuple) else bool(translation)


def main(arguments: list[str]) -> int:
    """Renew the catalogues; or, with ``--check``, say what is missing."""
    if "--check" in arguments:
        lacking = {code: missing(code) for code in CODES if code != DEFAULT}
        for code, entries in lacking.items():
            print(*(f"{code}: {entry}" for entry in entries), sep="\n")
        return int(any(lacking.values()))
    unknown = [code for code in arguments if not re.fullmatch("[a-z]{2,3}", code) or not localedata.exists(code)]
    if unknown:
        print(f"{unknown[0]!r} is no language that babel knows: give a code like fr, without a region", file=sys.stderr)
        return 2
    for code in sorted({*CODES, *arguments} - {DEFAULT}):
        written = io.BytesIO()  # the file is read while this is made
        write_po(written, renewed(code), width=0, no_location=True, sort_output=True)
        (HERE / f"{code}.po").write_bytes(written.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

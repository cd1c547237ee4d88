"""The tables of docs/python.md, made from the code: `python -m tests.stimrig.verbs_table` writes them into the page."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any, get_args

from typer.main import get_command

import stimrig
from stimrig.api.cli.commands.cohort import Verb
from stimrig.api.cli.main import build

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
COMMAND_ONLY = {
    "audit": "it reads the audit trail of a data folder; over HTTP: `client.get(\"/v1/audit\")`",
    "backup": "it looks after an installed machine's data folders",
    "demo": "`emulate`, `Client.run_test` and `Client.approve` one after the other",
    "export": "`read` and `save(record, \"record.parquet\")` do it for one record",
    "doctor": "it says what this machine lacks for stimulation",
    "recover": "it seals a journal on the rig's computer",
    "rig": "it asks a person who stands at the rig",
    "erase": "it deletes, alone with the data folder; a person asks for it",
    "serve": "it runs until it is ended, and may own a rig; `Client` talks to it",
}  # fmt: skip
ELSEWHERE = {"test": "Client.run_test"}
MORE = ("read", "join", "save", "carry", "next_experiment", "track", "plot", "Client")
"""What the page of the service and options of verbs do: `-o`, `--carry`, several DATA, what decides, trials."""


def verbs() -> dict[str, Any]:
    """All verbs of the command line, those of a group as `cohort fit`."""
    found: dict[str, Any] = {}
    for name, command in sorted(get_command(build()).commands.items()):
        below = {} if name in COMMAND_ONLY else getattr(command, "commands", {})
        below = dict.fromkeys(get_args(Verb), command) if name == "cohort" else below
        found |= {f"{name} {verb}": one for verb, one in below.items()} or {name: command}
    return found


def function_of(verb: str) -> tuple[str, Any]:
    """The function of a verb, and what it is called after `stimrig.`. Raises AttributeError: there is none."""
    called = ELSEWHERE.get(verb, verb.replace(" ", "."))
    first, *below = called.split(".")
    found: Any = stimrig.__getattr__(first)  # `stimrig.effects` is a module, too, once somebody has imported it
    for part in below:
        found = getattr(found, part)
    return called, found


def row(verb: str, called: str, function: Any) -> str:
    """One row: the verb, the function with what it must be given, what it returns, what it does."""
    told = str(inspect.signature(function).return_annotation).strip("'").replace("typing.", "")
    returns = "Client" if called == "Client" else re.sub(r"identify\.|Iterator\[(\w+)\]", r"\1", told)
    does = str(inspect.getdoc(function)).partition("\n\n")[0].replace("\n", " ")
    needed = [
        name for name, one in inspect.signature(function).parameters.items()
        if one.default is inspect.Parameter.empty and one.kind is one.POSITIONAL_OR_KEYWORD and name != "self"
    ]  # fmt: skip
    returns = returns.replace("|", "or")
    return f"| {verb} | `{called}({', '.join(needed)})` | `{returns}` | {does} |"


def table() -> str:
    """Verbs with their functions, then functions without a verb of their own, then verbs without a function."""
    named = [verb for verb in verbs() if verb not in COMMAND_ONLY]
    lines = ["| verb | function | returns | does |", "|---|---|---|---|"]
    lines += [row(f"`{verb}`", *function_of(verb)) for verb in named]
    lines += [row("–", name, getattr(stimrig, name)) for name in MORE]
    lines += [f"| `{verb}` | command line only | – | {why} |" for verb, why in COMMAND_ONLY.items()]
    return "\n".join(lines)


def methods() -> str:
    """The methods of `Client`, each with the first sentence of its docstring."""
    found = [(name, one) for name, one in vars(stimrig.Client).items() if not name.startswith("_")]
    lines = ["| method | does |", "|---|---|"]
    return "\n".join([*lines, *(f"| `{name}` | {str(inspect.getdoc(one)).splitlines()[0]} |" for name, one in found)])


def page(text: str) -> str:
    """The page with both tables as they are now."""
    for name, made in (("verbs", table()), ("methods", methods())):
        begin, end = f"<!-- {name}: made by python -m tests.stimrig.verbs_table -->\n", f"<!-- end of {name} -->"
        text = re.sub(f"(?s)(?<={re.escape(begin)}).*?(?={re.escape(end)})", lambda _, made=made: f"{made}\n", text)
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")

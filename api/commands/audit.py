"""`stimrig audit`: verify the chain of the audit trail, and export it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from api.terminal import Json, say, say_json, write

DataDir = Annotated[Path | None, typer.Option("--data", help="data folder; default ./var, or STIMRIG_DATA_DIR")]


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(no_args_is_help=True, help="Who did what, when, why: verify the chain of hashes, or export it.")
    verbs.command("verify")(verify)
    verbs.command("export")(export)
    app.add_typer(verbs, name="audit")


def verify(
    data: DataDir = None,
    file: Annotated[Path | None, typer.Option(help="an exported file instead of the database")] = None,
    head: Annotated[str, typer.Option(help="hash that was noted elsewhere: it must stand in the chain")] = "",
    as_json: Json = False,
) -> None:
    """Exit 0 if the chain holds; 1 if an entry was changed, taken out or put in."""
    from api import audit  # loads the database's library, for which no other verb should wait
    from api.audit_trail import read_export, stored

    entries = read_export(file) if file is not None else stored(data)
    broken = audit.first_broken(entries)
    missing = bool(head) and head not in {entry.hash for entry in entries}
    last = entries[-1].hash if entries else audit.GENESIS
    found = {"whole": broken is None and not missing, "first_broken": broken, "head_found": not missing,
             "entries": len(entries), "head": last}  # fmt: skip
    if as_json:
        say_json(found)
    elif broken is not None:
        say(f"broken at entry {broken}: it, or one before it, was changed, taken out or put in")
    elif missing:
        say(f"{head}: no entry has this hash; the trail was cut short or written anew")
    else:
        say(f"whole: {len(entries)} entries; head {last}")
        say("note the head elsewhere: --head finds out later whether the trail's end was cut off")
    if not found["whole"]:
        raise typer.Exit(1)


def export(
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write: one JSON object a line")],
    data: DataDir = None,
) -> None:
    """Write the trail, one entry a line; `verify --file` checks it without the database."""
    from api import audit
    from api.audit_trail import stored

    entries = stored(data)
    write(output, "".join(json.dumps(entry.as_dict(), sort_keys=True) + "\n" for entry in entries))
    say(f"{len(entries)} entries written to {output}; head {entries[-1].hash if entries else audit.GENESIS}")

"""`stimrig retention`: what the rules of retention let go, and what is kept of one participant, taken away."""

from __future__ import annotations

import getpass
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stimrig.api.cli.commands.audit import DataDir, open_store, settings_of
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import Json, say, say_json
from stimrig.api.clock import utc_label

if TYPE_CHECKING:
    from stimrig.api.models.erasure import Eraser, Kept
    from stimrig.api.settings import Settings

RigData = Annotated[
    list[Path] | None, typer.Option("--rig-data", help="the rig's data folder, where the service has one of its own")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="say what would be deleted; delete nothing")]
Delete = Annotated[bool, typer.Option("--delete", help="delete it; without this it is only said what would go")]
REMAINS = (
    "backups, until they are deleted by their age: restore none of them without erasing again",
    "folders that `stimrig backup restore --force` has set aside: ….before-… beside the data folders",
    "what was exported, downloaded or printed: files outside of the data folder are not known here",
    "the audit trail's numbers, times, persons, actions and hashes, without what the entries said",
)
"""Where something of an erased participant may still be, and why."""


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(
        name="retention",
        invoke_without_command=True,
        help="Say what is older than the settings STIMRIG_RETENTION_… let it be, and with --delete delete it.",
    )
    verbs.callback()(apply)
    verbs.command("erase")(erase)
    app.add_typer(verbs)


def apply(
    context: typer.Context, data: DataDir = None, rig_data: RigData = None, delete: Delete = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Say what is older than the settings STIMRIG_RETENTION_… let it be, and with --delete delete it."""
    dry_run = not delete
    if context.invoked_subcommand is not None:
        if data or rig_data or delete or as_json:  # they would be lost
            raise InputError(f"give the options behind {context.invoked_subcommand}, not before it. Nothing was done.")
        return
    settings = settings_of(data)
    with ExitStack() as stack:
        found = _applied(settings, _eraser(stack, settings, rig_data, dry_run), dry_run)
    if as_json:
        say_json(found)
        return
    did = "would go (--delete)" if dry_run else "deleted"
    for name, oldest in (("participants", "last_utc"), ("recordings", "created_utc"), ("logs", "changed_utc")):
        rows = found[name]
        since = f", the oldest of {rows[0][oldest]}" if rows else ""
        say(f"{name}: {len(rows)} {did}{since} ({found['rules'][name] or 'kept for ever: no rule'})")
    if found["unfinished"]:
        say(f"begun before and gone on with: {found['unfinished']}")


def _applied(settings: Settings, eraser: Eraser, dry_run: bool) -> dict[str, Any]:
    rules = {
        "participants": settings.retention_participants_days, "recordings": settings.retention_recordings_days,
        "logs": settings.retention_logs_days,
    }  # fmt: skip
    people, files, logs = (days and _words(days) for days in rules.values())
    unfinished, hold = len(eraser.waiting()), settings.retention_hold
    if not dry_run:
        eraser.finish()
    gone = eraser.old_participants(rules["participants"], hold) if rules["participants"] else []
    gone.sort(key=lambda one: one.last_utc)
    if not dry_run:
        for one in gone:
            eraser.erase(one.code, f"rule: {people} after the last test or recording", "retention")
    codes = {one.code for one in gone}
    rows = eraser.old_recordings(rules["recordings"], hold) if rules["recordings"] else []
    rows = [row for row in rows if row.participant not in codes]
    if not dry_run:
        eraser.remove_files(rows, f"rule: files of recordings, {files}", "retention")
    old = _old_logs(settings.logs_dir, rules["logs"], eraser.clock.unix_s())
    for path in [] if dry_run else [path for path, _ in old]:
        path.unlink(missing_ok=True)
    return {
        "dry_run": dry_run, "rules": {"participants": people, "recordings": files, "logs": logs},
        "held": list(hold), "unfinished": unfinished,
        "participants": [_document(one) for one in gone],
        "recordings": [{"id": row.id, "created_utc": row.created_utc, "file_sha256": row.file_sha256} for row in rows],
        "logs": [{"file": path.name, "changed_utc": utc_label(at_s)} for path, at_s in old],
    }  # fmt: skip


def erase(
    code: Annotated[str, typer.Argument(help="the participant's code")],
    reason: Annotated[str, typer.Option(help="why, as it stands in the audit trail: no name, no code")],
    data: DataDir = None,
    rig_data: RigData = None,
    dry_run: DryRun = False,
    though_in_use: Annotated[
        bool, typer.Option("--though-in-use", help="also where a model is approved or a controller's key is valid")
    ] = False,
    as_json: Json = False,
) -> None:
    """Delete all that is kept of a participant: recordings, models, notes, limits, keys."""
    settings = settings_of(data)
    if code in settings.retention_hold:
        raise InputError(f"{code}: STIMRIG_RETENTION_HOLD holds it. Take it out there once nothing needs it any more.")
    if not reason.strip() or code in reason:
        raise InputError("--reason: say why, in words that stay in the audit trail and do not name the participant.")
    with ExitStack() as stack:
        eraser = _eraser(stack, settings, rig_data, dry_run)
        number, kept = None, eraser.kept(code)
        if not dry_run:
            number, kept = eraser.erase(
                code, reason.strip()[:500], f"command line ({getpass.getuser()})", though_in_use
            )
    found = {"dry_run": dry_run, "erasure": number, **_document(kept), "in_use": kept.in_use, "remains": list(REMAINS)}
    if as_json:
        say_json(found)
        return
    say(f"{code}: {'would be deleted' if dry_run else f'deleted, as erasure {number}'}")
    say(*(f"  {rows:6d} {table}" for table, rows in kept.counts.items() if rows), f"  {len(kept.files):6d} files")
    if kept.in_use and dry_run:
        say(f"in use: {kept.in_use}; it goes only with --though-in-use")
    say("what may still be elsewhere:", *(f"  {where}" for where in REMAINS))


def _eraser(stack: ExitStack, settings: Settings, rig_data: list[Path] | None, dry_run: bool) -> Eraser:
    """Alone with the data, unless it only looks: no job of a service reads what is deleted."""
    from stimrig.api.clock import Clock
    from stimrig.api.models.erasure import Eraser
    from stimrig.api.store.holds import HeldError, ServiceLock

    for folder in rig_data or []:
        if not (folder / "recordings").is_dir():
            raise InputError(f"{folder}: there is no folder `recordings` in it. Give the rig's data folder.")
    with open_store(settings):  # before anything is made in a folder that is not the right one
        pass
    if not dry_run:
        try:
            stack.callback(ServiceLock(settings).release)
        except HeldError as error:
            raise InputError(f"{error}. Stop the service first: nothing is deleted beside it.") from error
    return Eraser(stack.enter_context(open_store(settings)), Clock(), [settings.data_dir, *(rig_data or [])])


def _document(kept: Kept) -> dict[str, Any]:
    return {"code": kept.code, "last_utc": kept.last_utc, "rows": kept.counts, "files": len(kept.files)}


def _old_logs(folder: Path, days: float | None, now_s: float) -> list[tuple[Path, float]]:
    """Logs that nobody has written to for so long, the oldest first."""
    if days is None or not folder.is_dir():
        return []
    found = [(path, path.stat().st_mtime) for path in folder.glob("*.log*") if path.is_file() and not path.is_symlink()]
    return sorted((one for one in found if now_s - one[1] > days * 86_400), key=lambda one: one[1])


def _words(days: float) -> str:
    return f"older than {days:g} days"

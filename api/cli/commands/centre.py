"""`stimrig centre`: serves a centre; adds and revokes rigs; reads the bucket's files again."""

from __future__ import annotations

import sys
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated

import typer
from tqdm import tqdm

from stimrig.api.cli.errors import CommandError, InputError
from stimrig.api.cli.terminal import given, say, say_json, sign_in_lines

DataOption = Annotated[Path | None, typer.Option(help="data folder; default ./centre, or STIMRIG_CENTRE_DATA_DIR")]
DatabaseOption = Annotated[
    str | None,
    typer.Option(help="URL of the database; default SQLite in the data folder, or STIMRIG_CENTRE_DATABASE_URL"),
]
FilesOption = Annotated[
    str | None,
    typer.Option(help="folder, or s3://bucket/prefix; default in the data folder, or STIMRIG_CENTRE_FILES"),
]
WHO = "command line"


def register(app: typer.Typer) -> None:
    """Add the verb."""
    centre = typer.Typer(name="centre", help="A centre that rigs push to.", invoke_without_command=True)
    centre.callback()(serve)
    centre.command("add-rig")(add_rig)
    centre.command("revoke-rig")(revoke_rig)
    centre.command("check")(check)
    app.add_typer(centre)


def serve(
    context: typer.Context,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="default 8100, or STIMRIG_CENTRE_PORT")] = None,
    host: Annotated[str | None, typer.Option(help="default 127.0.0.1, or STIMRIG_CENTRE_HOST")] = None,
    data: DataOption = None,
    database: DatabaseOption = None,
    files: FilesOption = None,
    demo: Annotated[bool, typer.Option("--demo", help="with PostgreSQL and two emulated rigs of its own")] = False,
) -> None:
    """The centre and its page, until Ctrl-C or SIGTERM."""
    named = given(port=port, host=host, data_dir=data, database_url=database, files=files)
    if context.invoked_subcommand is not None:
        context.obj = named
        return
    if demo:
        from stimrig.api.cli.centre_demo import play

        if database or files:
            raise InputError("--demo makes its own database and bucket: leave --database and --files out.")
        play(data or Path("centre-demo"), 8100 if port is None else port)
        return
    from stimrig.api.centre.server import prepared, run

    settings = settings_of(**named)
    try:
        app, listener = prepared(settings)
    except OSError as error:
        raise InputError(str(error)) from error
    how = (app.state.context.drawn_token, bool(settings.admin_token), "STIMRIG_CENTRE_ADMIN_TOKEN")
    head = f"with files in {settings.bucket}"
    run(app, listener, lambda url: say(f"stimrig centre: {url}/ {head}", *sign_in_lines(url, *how)))


def settings_of(**named):
    """The centre's settings. Raises SettingsError."""
    from stimrig.api.centre.context import CentreSettings

    return CentreSettings(**named)


def _opened(context: typer.Context, data: Path | None, database: str | None):
    """Settings, and the database of the centre."""
    from stimrig.api.centre.context import opened

    settings = settings_of(**{**(context.obj or {}), **given(data_dir=data, database_url=database)})
    if not {"data_dir", "database_url"} & settings.model_fields_set and not (settings.data_dir / "centre.db").exists():
        raise InputError(
            "no centre in ./centre. Give --data or --database as the centre has it, or its settings (docs/centre.md)."
        )
    return settings, opened(settings)


@contextmanager
def _rigs(context: typer.Context, data: Path | None, database: str | None):
    """The rigs of the centre; in the end its database is let go."""
    from stimrig.api.centre.rigs import Rigs
    from stimrig.api.clock import Clock
    from stimrig.api.people.pace import Guesses

    with closing(_opened(context, data, database)[1]) as store:
        yield Rigs(store, Clock(), Guesses(Clock()))


def add_rig(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="as people call it: Ward 3")],
    url: Annotated[str, typer.Option(help="where rigs reach the centre")] = "https://CENTRE",
    data: DataOption = None,
    database: DatabaseOption = None,
) -> None:
    """A new rig, or a new key for a revoked one; prints the key this once."""
    with _rigs(context, data, database) as rigs:
        key = rigs.add(name, WHO)
    say("settings for the rig's service, shown this once:", f"STIMRIG_CENTRE_URL={url}", f"STIMRIG_CENTRE_KEY={key}")


def revoke_rig(
    context: typer.Context, name: Annotated[str, typer.Argument()], data: DataOption = None,
    database: DatabaseOption = None,
) -> None:  # fmt: skip
    """The rig's key opens nothing any more; what it pushed stays."""
    with _rigs(context, data, database) as rigs:
        rigs.revoke(name, WHO)
    say(f"the key of {name} is revoked; what it pushed stays")


def check(
    context: typer.Context,
    since: Annotated[
        str | None, typer.Option(help="go on with what was not checked since, as 2026-11-23T08:00:00Z")
    ] = None,
    data: DataOption = None,
    database: DatabaseOption = None,
    files: FilesOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="print what was found as JSON")] = False,
) -> None:
    """Read the bucket's files again and compare them with their hashes; exit 1 where one differs."""
    from stimrig.api.centre import check as checking
    from stimrig.api.centre import clean
    from stimrig.api.centre.bucket import BucketError
    from stimrig.api.centre.context import ready_bucket
    from stimrig.api.clock import Clock

    clock = Clock()
    begun = since or clock.utc()
    if clean.label(begun, "") != begun:
        raise InputError(f"--since {begun}: give a time as 2026-11-23T08:00:00Z")
    settings, store = _opened(context, data, database)
    settings = settings.model_copy(update={"files": files}) if files else settings
    count, lost = 0, list[dict[str, str]]()
    try:
        bucket = ready_bucket(settings)
        print(f"stimrig centre check: if this is cut off, go on with --since {begun}", file=sys.stderr)
        total = checking.left_bytes(store, begun)
        with tqdm(total=total, unit="B", unit_scale=True, desc="read", disable=not sys.stderr.isatty()) as bar:
            for found in checking.check(store, bucket, clock, begun, bar.update):
                count += 1
                if not found.ok:
                    lost.append({"sha256": found.sha256, "says": found.words})
                    tqdm.write(f"{found.sha256}: {found.words}", file=sys.stderr if as_json else sys.stdout)
    except BucketError as error:
        raise CommandError(f"{error}; {count} files were checked, go on with --since {begun}") from error
    finally:
        store.close()
    if as_json:
        say_json({"since": begun, "checked": count, "differ": lost})
    else:
        say(f"{count} files checked, {len(lost)} differ" + ("; their rigs are asked for them again" if lost else ""))
    if lost:
        raise typer.Exit(1)

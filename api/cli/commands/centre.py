"""`stimrig centre`: serves a centre; adds and revokes rigs; reads the bucket's files again."""

from __future__ import annotations

import secrets
import socket
import sys
import threading
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from tqdm import tqdm

from stimrig.api import owner_only
from stimrig.api.cli.child import Child
from stimrig.api.cli.errors import CommandError, InputError, LaunchError
from stimrig.api.cli.launcher import Ended, Endings
from stimrig.api.cli.terminal import given, say, say_json, sign_in_lines
from stimrig.api.client.errors import ServiceError
from stimrig.api.client.rest import Client

if TYPE_CHECKING:
    from stimrig.api.centre.context import CentreSettings

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
    centre.command("erase")(erase)
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
        if database or files:
            raise InputError("--demo makes its own database and bucket: leave --database and --files out.")
        play(data or Path("centre-demo"), 8100 if port is None else port)
        return
    from stimrig.api.centre.context import CentreSettings
    from stimrig.api.centre.server import prepared, run

    settings = CentreSettings(**named)
    try:
        app, listener = prepared(settings)
    except OSError as error:
        raise InputError(str(error)) from error
    how = (app.state.context.drawn_token, bool(settings.admin_token), "STIMRIG_CENTRE_ADMIN_TOKEN")
    head = f"with files in {settings.bucket}"
    run(app, listener, lambda url: say(f"stimrig centre: {url}/ {head}", *sign_in_lines(url, *how)))


def _settings(context: typer.Context, data: Path | None, database: str | None) -> CentreSettings:
    """Those of a centre that is there."""
    from stimrig.api.centre.context import CentreSettings

    settings = CentreSettings(**{**(context.obj or {}), **given(data_dir=data, database_url=database)})
    if not {"data_dir", "database_url"} & settings.model_fields_set and not (settings.data_dir / "centre.db").exists():
        raise InputError(
            "no centre in ./centre. Give --data or --database as the centre has it, or its settings (docs/centre.md)."
        )
    return settings


@contextmanager
def _rigs(settings: CentreSettings):
    """The rigs of the centre; in the end its database is let go."""
    from stimrig.api.centre.context import open_store
    from stimrig.api.centre.rigs import Rigs
    from stimrig.api.clock import Clock
    from stimrig.api.people.pace import Guesses

    with closing(open_store(settings)) as store:
        yield Rigs(store, Clock(), Guesses(Clock()))


def add_rig(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="as people call it: Ward 3")],
    url: Annotated[str, typer.Option(help="where rigs reach the centre")] = "https://CENTRE",
    data: DataOption = None,
    database: DatabaseOption = None,
) -> None:
    """A new rig, or a new key for a revoked one; prints the key this once."""
    with _rigs(_settings(context, data, database)) as rigs:
        key = rigs.add(name, WHO)
    say("settings for the rig's service, shown this once:", f"STIMRIG_CENTRE_URL={url}", f"STIMRIG_CENTRE_KEY={key}")


def revoke_rig(
    context: typer.Context, name: Annotated[str, typer.Argument()], data: DataOption = None,
    database: DatabaseOption = None,
) -> None:  # fmt: skip
    """The rig's key opens nothing any more; what it pushed stays."""
    with _rigs(_settings(context, data, database)) as rigs:
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
    from stimrig.api.centre.context import open_store, ready_bucket
    from stimrig.api.clock import Clock

    clock = Clock()
    begun = since or clock.utc()
    if clean.label(begun, "") != begun:
        raise InputError(f"--since {begun}: give a time as 2026-11-23T08:00:00Z")
    settings = _settings(context, data, database)
    store = open_store(settings)
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


def erase(
    context: typer.Context,
    code: Annotated[str, typer.Argument(help="the participant's code")],
    reason: Annotated[str, typer.Option(help="why, as it stands in the audit trail: no name, no code")],
    data: DataOption = None,
    database: DatabaseOption = None,
    files: FilesOption = None,
    all_rigs: Annotated[bool, typer.Option("--all-rigs", help="also where several rigs told of the code")] = False,
) -> None:
    """Delete what all rigs have told of a participant, with the files; erase at the rigs first."""
    from stimrig.api.centre import erasure
    from stimrig.api.centre.bucket import BucketError
    from stimrig.api.centre.context import open_store, ready_bucket
    from stimrig.api.clock import Clock

    if not reason.strip() or code in reason:
        raise InputError("--reason: say why, in words that stay in the audit trail and do not name the participant.")
    settings = _settings(context, data, database)
    if settings.database_url is None and not (settings.data_dir / "centre.db").exists():
        raise InputError(f"{settings.data_dir / 'centre.db'}: there is no database. Give the data folder with --data.")
    settings = settings.model_copy(update={"files": files}) if files else settings
    with closing(open_store(settings)) as store:
        try:
            found = erasure.erase(store, ready_bucket(settings), Clock(), code, reason.strip()[:500], WHO, all_rigs)
        except BucketError as error:
            raise CommandError(f"{error}; give the same command once more: it goes on with the files") from error
    say(f"{code}: deleted with {found['files']} files, as erasure {found['erasure']}; backups still have it")


RIGS = (("Ward 1", "paper", "P001"), ("Ward 2", "calcium", "P002"))
"""Name, emulated muscle and participant of each rig."""
BETWEEN_S = 5.0
WATCH_S = 0.5


class EmulatedRig:
    """A rig with its service, which pushes to the centre; a thread plays one test after the other on it."""

    def __init__(self, folder: Path, name: str, patient: str, code: str, centre_url: str, key: str) -> None:
        self.name, self.code, self.token = name, code, secrets.token_urlsafe(24)
        self.port = free_port()
        command = [sys.executable, "-m", "stimrig", "serve", "--data", str(folder), "--port", str(self.port)]
        log = owner_only.folder(folder) / "service.log"
        self.child = Child(name, [*command, "--emulate", f"--patient {patient}"], log, {
            "STIMRIG_CENTRE_URL": centre_url, "STIMRIG_CENTRE_KEY": key, "STIMRIG_ADMIN_TOKEN": self.token,
            "PYTHONUNBUFFERED": "1", "STIMRIG_WORKERS": "1",
        })  # fmt: skip
        self.ending = threading.Event()
        self.player = threading.Thread(target=self._play, daemon=True)

    @property
    def url(self) -> str:
        """Its own page."""
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Start its processes, and what plays on it."""
        self.child.start_unheard()
        self.player.start()

    def _play(self) -> None:
        """One test after the other, each approved, until the end; a rig that is stopped waits for a person."""
        while not self.ending.wait(BETWEEN_S):
            with suppress(ServiceError), Client(self.url, self.token) as client:
                client.ensure_participant(self.code)
                test = client.run_test(self.code)
                if test["model_id"]:
                    client.approve(test["model_id"], "demo")

    def stop(self) -> None:
        """End it."""
        self.ending.set()
        self.child.end(45.0)


def play(folder: Path, port: int) -> None:
    """A whole centre on one machine, until Ctrl-C or SIGTERM: PostgreSQL, a folder as the bucket, two emulated rigs.

    Raises LaunchError: a process did not come up, or ended. SettingsError: PostgreSQL is not installed, or cannot be
    set up.
    """
    from stimrig.api.centre.postgres import Cluster

    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True, mode=0o711)  # PostgreSQL's user passes through it
    with suppress(Ended), Endings(), ExitStack() as stack:
        cluster = Cluster(folder / "postgres", free_port())
        stack.callback(cluster.stop)
        say("starting PostgreSQL, the centre and two emulated rigs")
        cluster.start()
        token = secrets.token_urlsafe(24)
        centre = _centre(folder, port, cluster.url, token)
        stack.callback(centre.end)
        url = str(centre.start()["url"])
        rigs = []
        for name, patient, code in RIGS:
            key = _key(folder, cluster.url, name)
            rig = EmulatedRig(folder / name.lower().replace(" ", "-"), name, patient, code, url, key)
            stack.callback(rig.stop)
            rig.start()
            rigs.append(rig)
        pages = [f"{rig.name}: {rig.url}/sign-in#token={rig.token}" for rig in rigs]
        say(f"the centre's page: {url}/sign-in#token={token}", *pages, f"files and logs in {folder}")
        say("each rig plays a test of about a minute, and pushes it by itself; Ctrl-C ends all")
        _watch([centre, *(rig.child for rig in rigs)])
    say("ended; what was recorded is kept")


def _centre(folder: Path, port: int, database: str, token: str) -> Child:
    data = owner_only.folder(folder / "centre")
    (folder / "bucket").mkdir(exist_ok=True, mode=0o700)
    environment = {
        "STIMRIG_CENTRE_DATA_DIR": str(data), "STIMRIG_CENTRE_DATABASE_URL": database,
        "STIMRIG_CENTRE_FILES": str(folder / "bucket"), "STIMRIG_CENTRE_PORT": str(port),
        "STIMRIG_CENTRE_ADMIN_TOKEN": token, "STIMRIG_CENTRE_HOST": "127.0.0.1",
    }  # fmt: skip
    return Child("centre", [sys.executable, "-m", "stimrig.api.centre.server"], folder / "centre.log", environment)


def _key(folder: Path, database: str, name: str) -> str:
    """A new key for a rig; one from before is revoked."""
    from stimrig.api.centre.context import CentreSettings

    with _rigs(CentreSettings(data_dir=folder / "centre", database_url=database)) as rigs:
        if rigs.named(name) is not None:
            rigs.revoke(name, "demo")
        return rigs.add(name, "demo")


def _watch(children: list[Child]) -> None:
    """Until the end; a process that ends by itself ends all."""
    waiting = threading.Event()
    while not waiting.wait(WATCH_S):
        for child in children:
            if not child.alive():
                raise LaunchError(
                    f"{child.name} has ended: {child.last_words() or 'without a message'} (log: {child.log})"
                )


def free_port() -> int:
    """A port on which nobody listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]

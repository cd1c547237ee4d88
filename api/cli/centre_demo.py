"""A whole centre on one machine: PostgreSQL, a folder as the bucket, two emulated rigs that push."""

from __future__ import annotations

import contextlib
import secrets
import socket
import sys
import threading
from pathlib import Path

from stimrig.api import owner_only
from stimrig.api.centre.context import CentreSettings, opened
from stimrig.api.centre.postgres import Cluster
from stimrig.api.centre.rigs import Rigs
from stimrig.api.cli.child import Child
from stimrig.api.cli.errors import LaunchError
from stimrig.api.cli.launcher import Ended, Endings
from stimrig.api.cli.terminal import say
from stimrig.api.client.errors import ServiceError
from stimrig.api.client.rest import Client
from stimrig.api.clock import Clock
from stimrig.api.people.pace import Guesses

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
            with contextlib.suppress(ServiceError), Client(self.url, self.token) as client:
                client.ensure_participant(self.code)
                test = client.run_test(self.code)
                if test["model_id"]:
                    client.approve(test["model_id"], "demo")

    def stop(self) -> None:
        """End it."""
        self.ending.set()
        self.child.end(45.0)


def play(folder: Path, port: int) -> None:
    """All of it, until Ctrl-C or SIGTERM.

    Raises
    ------
    LaunchError
        A process did not come up, or ended.
    SettingsError
        PostgreSQL is not installed, or cannot be set up.
    """
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True, mode=0o711)  # PostgreSQL's user passes through it
    with contextlib.suppress(Ended), Endings(), contextlib.ExitStack() as stack:
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
    with contextlib.closing(opened(CentreSettings(data_dir=folder / "centre", database_url=database))) as store:
        rigs = Rigs(store, Clock(), Guesses(Clock()))
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

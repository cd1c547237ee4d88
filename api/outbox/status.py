"""How the pushing goes, for people: written by the pusher into the data folder, read by page, doctor and metrics."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stimrig.api.clock import unix_of, utc_label
from stimrig.api.settings import Settings
from stimrig.api.whole_file import whole_file

NAME = "outbox.json"
WORDS: dict[str, Any] = {
    "starting": "The first contact is being made.",
    "current": "The centre has everything.",
    "sending": "The centre is being told what is new.",
    "damaged": "Everything was sent but for files that are missing or damaged. Restore them from a backup.",
    "unreachable": "The centre cannot be reached. Nothing is lost: what waits is sent as soon as it answers.",
    "key-refused": "The centre refuses this rig's key: it is unknown there, or was revoked. Ask for a new one.",
    "wrong-answer": "What answers at the centre's address does not speak as a centre does. Check the address.",
    "bucket-failed": "The centre cannot keep files: its bucket is full or gone. Nothing is lost; they wait here.",
    "refused": "The centre refused what was sent. Nothing is lost; it is tried again.",
    "database": "The rig's database could not be read for the centre. It is tried again.",
    "not-running": "Nothing is being sent: the process that tells the centre does not run.",
}
"""What each state means, as a page says it."""
FIXES = {
    "damaged": "restore the files from a backup (docs/install.md)",
    "unreachable": "look at the network and the centre; nothing is lost meanwhile",
    "key-refused": "ask the centre's administrator for a new key, set STIMRIG_CENTRE_KEY and start again",
    "wrong-answer": "set STIMRIG_CENTRE_URL to the centre's own address",
    "bucket-failed": "tell the centre's administrator: its bucket is full or gone",
    "not-running": "`stimrig serve` and stimrig-outbox.service run it; by hand: python -m stimrig.api.outbox",
}
GOOD = ("starting", "current", "sending")


@dataclass(frozen=True)
class Status:
    """How it goes."""

    state: str  # one of `WORDS`
    detail: str  # what was wrong at last, on one line; empty: nothing
    centre: str  # its address
    at_utc: str
    good_until_utc: str  # nothing written until then: the process that writes this does not run
    last_contact_utc: str | None = None  # when the centre last answered as it should
    chain: str | None = None  # of what `seq` is about
    seq: int = 0  # the newest item that the centre has, as far as known
    items_waiting: int = 0  # what the centre lacks
    files_waiting: int = 0  # the same, as far as it has told which
    damaged: tuple[str, ...] = ()  # SHA-256 of files that are missing or damaged, the first ones
    damaged_count: int = 0

    def since_contact_s(self, now_unix_s: float) -> float | None:
        """Time since the centre last answered, s."""
        return None if self.last_contact_utc is None else max(0.0, now_unix_s - unix_of(self.last_contact_utc))


def write(folder: Path, status: Status) -> None:
    """Put it into its place: whoever reads has the one before, or this one, whole."""
    with whole_file(folder / NAME, mode=0o600) as file:
        file.write(json.dumps(asdict(status)).encode() + b"\n")


def read(settings: Settings, now_unix_s: float) -> Status | None:
    """How it goes now; None where no centre is configured."""
    if settings.centre_url is None:
        return None
    status = last(settings)
    if status is None:
        now_utc = utc_label(now_unix_s)
        return Status("not-running", "", settings.centre_url, now_utc, now_utc)
    if unix_of(status.good_until_utc) < now_unix_s:
        return Status(**{**asdict(status), "state": "not-running", "detail": ""})
    return status


def last(settings: Settings) -> Status | None:
    """What was last written about the centre of these settings; None where nothing was, or it cannot be read."""
    try:
        found = json.loads((settings.data_dir / NAME).read_text("utf-8"))
        status = Status(**{**found, "damaged": tuple(found["damaged"])})
        unix_of(status.good_until_utc), status.since_contact_s(0.0), int(status.seq)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return status if status.centre == settings.centre_url and status.state in WORDS else None

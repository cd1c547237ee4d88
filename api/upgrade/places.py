"""Who holds the data meanwhile, and what must be as it is before they are changed."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stimrig.api.settings import Settings
from stimrig.api.store.holds import HeldError, ServiceLock

HOLDER = "stimrig upgrade"
NEW_RIG_KEYS = ("switch", "require_check", "stimulator.channels", "load_cell.fault", "watch.unmoved_torque_s")
"""Keys of a rig file that version 0.1 refuses; every other one is read by both."""
NEW_SETTINGS = ("STIMRIG_HEADS_FILE", "STIMRIG_OIDC_", "STIMRIG_OTLP_ENDPOINT", "STIMRIG_RETENTION_")
"""How the settings begin that version 0.1 passes over; every other one is read by both."""


class UpgradeError(Exception):
    """Nothing was changed; one line: the place, what is wrong, what to do."""


@contextlib.contextmanager
def held(settings: Settings, rig_data: Path) -> Iterator[None]:
    """Nobody else uses the data: a service or a rig, of whichever version, that starts now refuses in one line.

    Raises UpgradeError: one of them runs, or the data are another user's.
    """
    for folder in (settings.data_dir, rig_data):
        if not folder.is_dir():
            raise UpgradeError(f"{folder}: no such folder; give the data folder with --data")
        if os.geteuid() not in (0, folder.stat().st_uid):
            raise UpgradeError(f"{folder}: it is another user's; run this as root: sudo stimrig upgrade …")
    with _rig_lock(rig_data), _as_owner(settings.data_dir):
        try:
            lock = ServiceLock(settings)
        except HeldError as error:
            raise UpgradeError(str(error)) from error
        try:
            lock.tell(HOLDER)
            yield
        finally:
            lock.release()


@contextlib.contextmanager
def _as_owner(folder: Path) -> Iterator[None]:
    """As root: what is made in the folder is its owner's, whose service goes on with it."""
    before = os.geteuid(), os.getegid()
    if before[0] == 0:
        found = folder.stat()
        os.setegid(found.st_gid)
        os.seteuid(found.st_uid)
    try:
        yield
    finally:
        if before[0] == 0:
            os.seteuid(before[0])
            os.setegid(before[1])


@contextlib.contextmanager
def _rig_lock(folder: Path) -> Iterator[None]:
    """The lock by which one rig has the folder for itself (`stimrig.rig.adapters.files`)."""
    with (folder / "rig.lock").open("a+") as file:
        if os.geteuid() == 0:  # it may be new
            os.fchown(file.fileno(), folder.stat().st_uid, folder.stat().st_gid)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            raise UpgradeError(f"{folder}: a rig (process {file.read().strip()}) uses it; stop it first") from None
        file.truncate(0)
        file.write(f"{os.getpid()}, {HOLDER}")
        file.flush()
        yield


def refuse_unsealed(rig_data: Path) -> None:
    """Version 0.1 may not read a journal of this one. Raises UpgradeError: there is one."""
    journal = next((rig_data / "journals").glob("*.journal"), None)
    if journal is not None:
        raise UpgradeError(
            f"{journal}: a test that was cut short; start the rig once, so that it is sealed, then go back"
        )


def notes(rig_data: Path, rig_file: Path | None, back: bool) -> list[str]:
    """What the older version will not read, of what stands outside of the database. Raises UpgradeError."""
    if not back:
        return []
    told = [f"{name}: version 0.1 passes over this setting." for name in os.environ if name.startswith(NEW_SETTINGS)]
    if (rig_data / "calibrated.json").exists():
        told.append(
            f"{rig_data / 'calibrated.json'}: a calibration nobody has stored; it stays, version 0.1 passes over it."
        )
    refused = "version 0.1 refuses this key. Keep a copy, and take it out by hand."
    return told + [f"{rig_file}: {key}: {refused}" for key in _keys_of(rig_file)]


def _keys_of(rig_file: Path | None) -> list[str]:
    if rig_file is None:
        return []
    try:
        content = tomllib.loads(rig_file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UpgradeError(f"{rig_file}: cannot be read ({error}); give the rig file") from error
    return [key for key in NEW_RIG_KEYS if _has(content, key)]


def _has(content: Any, key: str) -> bool:
    for name in key.split("."):
        if not isinstance(content, dict) or name not in content:
            return False
        content = content[name]
    return True


def read_state(path: Path) -> dict[str, Any]:
    """What an upgrade that was cut short had done; empty where there is none, or it cannot be read."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}

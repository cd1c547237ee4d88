"""When a backup was last made, and when one was last restored for trial: a small file beside the database."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from stimrig.api.clock import unix_of
from stimrig.api.whole_file import whole_file

STATE = "backups.json"


@dataclass(frozen=True)
class Backups:
    """What is known of the backups of a data folder; empty: never."""

    created_utc: str = ""
    created_bytes: int = 0
    verified_utc: str = ""
    """When a backup was last restored for trial, and all held."""
    verified_of_utc: str = ""
    """When that backup had been made."""
    verified_s: float = 0.0
    failed_utc: str = ""
    problem: str = ""
    """What did not hold in the last trial, and when; empty: all did."""

    @property
    def created_unix_s(self) -> float:
        """0: never."""
        return unix_of(self.created_utc) if self.created_utc else 0.0

    @property
    def verified_unix_s(self) -> float:
        """0: never."""
        return unix_of(self.verified_utc) if self.verified_utc else 0.0


def read(api_data: Path) -> Backups:
    """What is known; nothing where the file is not there or cannot be read."""
    try:
        content = json.loads((api_data / STATE).read_text("utf-8"))
        found = Backups(**content)
        _ = found.created_unix_s, found.verified_unix_s
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return Backups()
    return found


def note(api_data: Path, **changed: Any) -> None:
    """Keep what is known now, owned as the folder is: a check is often made by root, and the service reads it."""
    path = api_data / STATE
    with whole_file(path, mode=0o640) as file:
        file.write(json.dumps(asdict(replace(read(api_data), **changed)), indent=1).encode())
        if os.geteuid() == 0:
            owner = api_data.stat()
            os.fchown(file.fileno(), owner.st_uid, owner.st_gid)

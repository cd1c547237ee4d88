"""What the rig knows of its last check (`stimrig rig check`): told in the status; a rig file may require it."""

from __future__ import annotations

import hashlib
import json
import logging
from datetime import datetime
from pathlib import Path

from stimrig.rig.config import RigConfig
from stimrig.rig.errors import CheckNeededError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import CheckStatus

CHECK_FILE = "check.json"
OF_THE_PLACE = "data_dir", "socket", "clock_speed", "require_calibration", "require_check"
"""Keys that say where and how a rig is used, not of what it is made."""

NEVER = CheckStatus.model_validate({})
log = logging.getLogger("rig.checked")


def fingerprint(config: RigConfig) -> str:
    """SHA-256 of what a rig is made of: devices, what describes their frames, limits and watch."""
    content = {name: value for name, value in config.public().items() if name not in OF_THE_PLACE}
    for name, device in content.items():  # the content of a DBC file, wherever it lies
        path = Path(str(device.get("dbc", ""))) if isinstance(device, dict) else Path()
        if path.suffix == ".dbc" and path.is_file():
            content[name] = {**device, "dbc": hashlib.sha256(path.read_bytes()).hexdigest()}
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


class Checked:
    """Read once, as the rig opens: a check is only done while no rig runs."""

    def __init__(self, config: RigConfig, machine: Machine) -> None:
        self._path, self._machine = config.data_dir / CHECK_FILE, machine
        self._rig, self._required = fingerprint(config), config.require_check
        self._told = config.require_calibration or config.require_check
        """Whether a rig that was never checked says so: one for persons does, an emulated one does not."""
        self._found: CheckStatus | None = None

    def recall(self) -> None:
        """Read what the last check left, as work of another thread; what cannot be read counts as none."""
        try:
            content = json.loads(self._machine.disk.read(self._path))
            self._found = CheckStatus(
                verdict=content["verdict"],
                checked_at_utc=content["checked_at_utc"],
                due_at_utc=content["due_at_utc"],
                by=str(content["by"]),
                same_rig=content["rig"] == self._rig,
                due="",
            )
            datetime.fromisoformat(self._found.due_at_utc or "")
        except FileNotFoundError:
            self._found = None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            self._found = None
            log.warning("%s: not readable (%s); check the rig again", self._path, " ".join(str(error).split()))

    def status(self) -> CheckStatus | None:
        """The last check, and why another one is due; None: there is none, and none is expected."""
        found = self._found or (NEVER if self._told else None)
        return found and found.model_copy(update={"due": self._due(found)})

    def refuse(self) -> None:
        """Raise CheckNeededError if the rig file requires a valid check and there is none."""
        if not self._required:
            return
        if due := self._due(self._found or NEVER):
            raise CheckNeededError(f"{due}; stop the rig and run `stimrig rig check`")

    def _due(self, found: CheckStatus) -> str:
        """Why a check is due, in words; empty: it is not."""
        if found.verdict is None or found.due_at_utc is None:
            return "the rig was never checked"
        if found.verdict != "sound":
            return "the last check of the rig found it not sound"
        if not found.same_rig:
            return "the rig file has changed since the last check of the rig"
        due_s = datetime.fromisoformat(found.due_at_utc).timestamp()
        return "" if self._machine.tasks.clock.unix_s() < due_s else "the check of the rig is due again"

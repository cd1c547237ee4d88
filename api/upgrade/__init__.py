"""Data of an older version brought to this one, and back: told before, copied before, resumable (docs/versions.md)."""

from stimrig.api.upgrade.run import Request, UpgradeError, upgrade

__all__ = ["Request", "UpgradeError", "upgrade"]

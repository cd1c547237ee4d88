"""Tables: those of TOML and JSON files, which describe patients and arms, and those of kinds of devices by name."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from stimrig.hardware_sim.errors import HardwareSimError, SettingsError

Kind = TypeVar("Kind")


def read_table(path: Path, error: type[HardwareSimError], content: str) -> dict[str, Any]:
    """The table that a file holds.

    `error`: what is raised where it cannot be read, is neither TOML nor JSON, or holds something else; names the file.
    `holds`: what should be in it, for the message.
    """
    is_json = path.suffix.lower() == ".json"
    try:
        text = path.read_text(encoding="utf-8")
        described = json.loads(text) if is_json else tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as reason:
        raise error(f"{path}: cannot be read ({reason}); give a readable TOML or JSON file") from None
    except (ValueError, RecursionError) as reason:  # a ValueError of either decoder names line and column
        raise error(f"{path}: not valid {'JSON' if is_json else 'TOML'}: {reason}") from None
    if not isinstance(described, dict):
        raise error(f"{path}: must hold {content}")
    return described


def pick(kinds: Mapping[str, Kind], what: str, name: str) -> Kind:
    """The one of this name. Raises SettingsError: there is none; the message lists all."""
    if name not in kinds:
        raise SettingsError(f"unknown {what} '{name}'; there are {', '.join(kinds)}")
    return kinds[name]

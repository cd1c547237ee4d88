"""Tables of a TOML or JSON file, as patients and arms are described."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from stimrig.hardware_sim.errors import HardwareSimError


def read_table(path: Path, error: type[HardwareSimError], holds: str) -> dict[str, Any]:
    """The table that a file holds.

    Parameters
    ----------
    error : type
        What is raised where it cannot be read, is neither TOML nor JSON, or holds something else; names the file.
    holds : str
        What should be in it, for the message.
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
        raise error(f"{path}: must hold {holds}")
    return described

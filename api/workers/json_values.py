"""Values as JSON holds them."""

from __future__ import annotations

import math
from typing import Any


def clean(value: Any) -> Any:
    """A value as JSON holds it: arrays as lists, numbers that are none as null."""
    if isinstance(value, dict):
        return {str(key): clean(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [clean(item) for item in value]
    if hasattr(value, "tolist"):
        return clean(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

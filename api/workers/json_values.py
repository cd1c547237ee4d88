"""Values as JSON holds them."""

from stimrig.identify.json_text import json_value as clean

__all__ = ["clean"]

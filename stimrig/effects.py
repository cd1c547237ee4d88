"""What a file with an effect of one's own imports (docs/add-an-effect.md); called, `stimrig.effects()`, the library."""

import sys
from types import ModuleType
from typing import Any

from stimrig.identify.effects import Effect, Form, Parameter, Scene, form, library

__all__ = ["Effect", "Form", "Parameter", "Scene", "form"]


class _Library(ModuleType):
    """`stimrig.effects` is a function, too: also where this module has been imported."""

    def __call__(self) -> list[dict[str, Any]]:
        return library()


sys.modules[__name__].__class__ = _Library

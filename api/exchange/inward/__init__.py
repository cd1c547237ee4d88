"""Formats of `stimrig import`: each module is a `Reader` and is found by scanning this folder.

A reader names what the file holds and never what of it is the torque: that is asked for (`taking`), unless the file is
one of our own. Sealed recordings, CSV and MAT files are DATA: every verb reads them as they are.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Protocol

from stimrig.api.exchange.inward.foreign import Foreign, whole
from stimrig.identify.errors import BadRecord, IdentifyError
from stimrig.identify.records import HDF5_MAGIC, bounds
from stimrig.identify.records.mat import is_mat

HEAD_BYTES = 4096
OWN = (".csv", ".txt", ".tsv", ".mat")


class Reader(Protocol):
    """A format: a module."""

    NAME: str

    def reads(self, path: Path, head: bytes, /) -> bool:
        """Whether it is the format of a file with this name and these first bytes."""
        ...

    def read(self, path: Path, content: bytes) -> Foreign:
        """What the file holds. Raises BadRecord."""
        ...


def readers() -> list[Reader]:
    """All formats."""
    found = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    return [module for module in found if hasattr(module, "reads")]  # pyright: ignore[reportReturnType]


def read_foreign(path: Path) -> Foreign:
    """What a file of another tool holds. Raises BadRecord: no format of these, damaged, or too large."""
    content = bounds.content_of(path)
    known = readers()
    reader = next((one for one in known if one.reads(path, content[:HEAD_BYTES])), None)
    if reader is None:
        data = content.startswith(HDF5_MAGIC) or is_mat(content) or path.suffix.lower() in OWN
        names = ", ".join(one.NAME for one in known)
        fix = "Give it to fit, diagnose and the others as it is, with --map." if data else f"Import reads {names}."
        message = "a sealed recording or a table, which needs no import" if data else "no format that is known"
        raise BadRecord(message, place=str(path), fix=fix)
    try:
        return whole(reader.read(path, content), str(path))
    except IdentifyError:
        raise
    except ImportError as error:
        fix = f"Needs `pip install stimrig[files]` ({error.name} is missing)."
        raise BadRecord(f"a file of {reader.NAME}", place=str(path), fix=fix) from None
    except MemoryError:
        raise BadRecord("it takes more memory than there is", place=str(path), fix="Cut the recording.") from None
    except Exception as error:  # a library's reader at a damaged file: whatever it raises
        message = f"damaged, or no {reader.NAME} file ({type(error).__name__})"
        raise BadRecord(message, place=str(path), fix="Give the whole file, as the tool wrote it.") from error

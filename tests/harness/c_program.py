"""examples/controller.c, compiled where gcc, libcurl and cJSON are installed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[2] / "examples" / "controller.c"
HEADERS = "#include <cjson/cJSON.h>\n#include <curl/curl.h>\n"
LIBRARIES = ("-lcurl", "-lcjson", "-lm")


def compiled(folder: Path) -> Path:
    """The program in a folder; without the libraries the test is skipped, with the reason."""
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("not compiled: there is no gcc")
    flags = os.environ.get("STIMRIG_TEST_CFLAGS", "").split()
    there = subprocess.run([gcc, *flags, "-E", "-"], input=HEADERS, text=True, capture_output=True, check=False)
    if there.returncode != 0:
        pytest.skip("not compiled: libcurl4-openssl-dev and libcjson-dev are not installed")
    out = folder / "controller"
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([gcc, *strict, *flags, "-o", str(out), str(PROGRAM), *LIBRARIES], check=True)
    return out

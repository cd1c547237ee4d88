"""Build backend: setuptools on a clean copy of the sources, then an archive of the same bytes wherever it is built.

The bytes do not depend on umask, clock, folder or order of files, nor on what an earlier build left. Every file bears
the time of the commit: of SOURCE_DATE_EPOCH, of git, or of `commit-time`, which `git archive` and the sdist fill in.
"""

from __future__ import annotations

import contextlib
import gzip
import os
import shutil
import subprocess
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import build_editable

__all__ = ["build_editable", "build_sdist", "build_wheel"]

ROOT = Path(__file__).resolve().parents[1]
COMMIT_TIME = Path("deploy/commit-time")
SHIPPED = ("pyproject.toml", "README.md", "LICENSE", "CITATION.cff", "deploy/backend.py", str(COMMIT_TIME))
"""Beside the package `stimrig`: what an sdist needs to build the same wheel, and what it must tell."""
NO_COMMIT_S = 1577836800
"""2020: where neither git nor an archive of it knows the commit."""


def build_wheel(directory: str, settings: dict[str, Any] | None = None, _metadata: str | None = None) -> str:
    """Build the wheel; its name."""
    return _build(directory, lambda built: build_meta.build_wheel(built, settings), _rewrite_wheel)


def build_sdist(directory: str, settings: dict[str, Any] | None = None) -> str:
    """Build the sdist; its name."""
    return _build(directory, lambda built: build_meta.build_sdist(built, settings), _rewrite_sdist)


def commit_time_s() -> int:
    """When what is built was committed, in seconds since 1970."""
    told = os.environ.get("SOURCE_DATE_EPOCH") or (ROOT / COMMIT_TIME).read_text("utf-8").strip()
    if told.isdecimal():
        return int(told)
    if (ROOT / ".git").exists():  # of this tree, not of one that it lies in
        command = ["git", "-c", "safe.directory=*", "-C", str(ROOT), "log", "-1", "--format=%ct"]
        with contextlib.suppress(FileNotFoundError):
            answer = subprocess.run(command, capture_output=True, text=True)
            return int(answer.stdout) if answer.stdout.strip().isdecimal() else NO_COMMIT_S
    return NO_COMMIT_S


def _build(directory: str, build: Callable[[str], str], rewrite: Callable[[Path, Path, int], None]) -> str:
    time_s, target = commit_time_s(), Path(directory).resolve()
    with tempfile.TemporaryDirectory(prefix="stimrig-build-") as folder:
        source, built = Path(folder) / "source", Path(folder) / "built"
        _copy_sources(source, time_s)
        built.mkdir()
        with contextlib.chdir(source):
            name = build(str(built))
        rewrite(built / name, target / name, time_s)
    return name


def _copy_sources(source: Path, time_s: int) -> None:
    """What is shipped, links followed: `stimrig/rig` and its like are folders of their own there."""
    leave = shutil.ignore_patterns("__pycache__", "*.pyc", "*.nbi", "*.nbc", "*.egg-info")
    shutil.copytree(ROOT / "stimrig", source / "stimrig", ignore=leave, copy_function=shutil.copyfile)
    for name in SHIPPED:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, source / name)
    (source / COMMIT_TIME).write_text(f"{time_s}\n", "utf-8")
    (source / "MANIFEST.in").write_text("".join(f"include {name}\n" for name in SHIPPED), "utf-8")


def _rewrite_wheel(old: Path, new: Path, time_s: int) -> None:
    stamp = time.gmtime(max(time_s, 315532800))[:6]  # a ZIP file begins in 1980
    with zipfile.ZipFile(old) as made, zipfile.ZipFile(new, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as wheel:
        for name in sorted(made.namelist(), key=lambda name: (".dist-info/" in name, name)):
            entry = zipfile.ZipInfo(name, stamp)
            entry.external_attr, entry.compress_type, entry.create_system = 0o100644 << 16, zipfile.ZIP_DEFLATED, 3
            wheel.writestr(entry, made.read(name), compresslevel=9)


def _rewrite_sdist(old: Path, new: Path, time_s: int) -> None:
    with tarfile.open(old) as made, _packed(new) as sdist:
        for entry in sorted((entry for entry in made if entry.isfile()), key=lambda entry: entry.name):
            plain = tarfile.TarInfo(entry.name)
            plain.size, plain.mtime, plain.mode = entry.size, time_s, 0o644
            sdist.addfile(plain, made.extractfile(entry))


@contextlib.contextmanager
def _packed(path: Path) -> Iterator[tarfile.TarFile]:
    with (
        path.open("wb") as raw,
        gzip.GzipFile("", "wb", 9, raw, mtime=0) as packed,  # its header names neither file nor time
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        yield archive

"""`python -m tests.runner.changed_types`: the type checker on what changed since it last had nothing to say.

What it says of a file follows from the file, from what that imports, directly or not, and from the checker with its
settings and installed packages. Where none of these has changed, it isn't asked again. `make types` asks it of all.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import grimp

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "build" / "tests" / "types.json"


def module(path: Path) -> str:
    """A file's name to those who import it."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def with_packages(names: Iterable[str]) -> set[str]:
    """Modules, and the packages that they are in: importing one imports these."""
    return {
        ".".join(parts[:count]) for parts in (name.split(".") for name in names) for count in range(1, len(parts) + 1)
    }


def keys(content: dict[str, str], imported: dict[str, set[str]], settings: str) -> dict[str, str]:
    """One word for each module that changes with anything that the checker's answer follows from.

    Parameters
    ----------
    content : what each module holds.
    imported : what each imports, directly or not.
    settings : of the checker.
    """
    found = {}
    for name in content:
        on = sorted(with_packages({name} | imported.get(name, set())))
        text = json.dumps([settings, name, [(one, content.get(one)) for one in on]])
        found[name] = hashlib.sha256(text.encode()).hexdigest()
    return found


def checked(settings: dict[str, Any]) -> dict[str, Path]:
    """The files that the checker is asked of, by their modules; like it, no link below a folder is followed."""
    return {module(path): path for name in settings["include"] for path in (ROOT / name).rglob("*.py")}


def imports_of(package: str) -> dict[str, set[str]]:
    """What each module imports, directly or not, a package's own files included."""
    graph = grimp.build_graph(package, cache_dir=None)
    return {name: set(graph.find_upstream_modules(name)) for name in graph.modules}


def main() -> int:
    """The checker's exit code; 0 without asking it where nothing has changed."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["basedpyright"]
    files = checked(settings)
    locked = (ROOT / "requirements" / "test.txt").read_text()
    content = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
    now = keys(content, imports_of("stimrig"), json.dumps([settings, locked, sys.version]))
    try:
        before = json.loads(KEPT.read_text())
    except (OSError, ValueError):
        before = {}
    changed = [name for name, key in now.items() if before.get(name) != key]
    print(f"{len(changed)} of {len(now)} modules have changed, or something that they import", flush=True)
    if not changed:
        return 0
    checker = str(Path(sys.executable).parent / "basedpyright")
    code = subprocess.run([checker, "--level", "error", *(str(files[name]) for name in changed)], cwd=ROOT).returncode
    if code == 0:
        KEPT.parent.mkdir(parents=True, exist_ok=True)
        KEPT.write_text(json.dumps(now))
    return code


if __name__ == "__main__":
    sys.exit(main())

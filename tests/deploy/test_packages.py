"""What is handed out: wheel and sdist, what they need, and the container's file."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml

from bench.muscles import hidden_records

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
MOST_BYTES = 3 * 2**20


@pytest.mark.slow
def test_the_wheel_holds_all_packages_with_their_data(tmp_path: Path) -> None:
    """`python -m build` makes the sdist of a copy of the checkout, and the wheel of the sdist.

    In the checkout itself it would leave half-written metadata that the tests beside this one read.
    """
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    every = [name for name in listed.splitlines() if (ROOT / name).exists()]
    for name in every:
        (copy := tmp_path / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy, follow_symlinks=False)
    command = [sys.executable, "-m", "build", "--no-isolation", "-o", str(tmp_path), str(tmp_path / "checkout")]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    answer = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-2000:]
    names = set(zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist())
    assert {name.partition("/")[0] for name in names} == {"stimrig", f"stimrig-{PROJECT['version']}.dist-info"}
    ours = [name for name in every if name.startswith(("api/", "rig/", "identify/", "hardware_sim/"))]
    assert {name for name in ours if f"stimrig/{name}" not in names} == set()
    assert {"stimrig/py.typed", "stimrig/api/py.typed"} <= names
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as sdist:
        inside = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"LICENSE", "CITATION.cff", "pyproject.toml"} <= inside
    assert not {name for name in inside if name.startswith(("tests/", "bench/", "docs/"))}
    assert all(path.stat().st_size <= MOST_BYTES for path in (*tmp_path.glob("*.whl"), *tmp_path.glob("*.tar.gz")))


def test_the_version_stands_once_and_is_cited() -> None:
    """What else tells a version takes the installed one: `api/version.py`, `identify/model.py`, the rig."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert cited["version"] == PROJECT["version"] and cited["license"] == PROJECT["license"]
    assert cited["keywords"] == PROJECT["keywords"]


# ---- extras ---------------------------------------------------------------------------------------------------------


def closure(wanted: Sequence[str]) -> set[str]:
    """Names of distributions that these requirements bring, here."""
    found: set[str] = set()
    waiting = [re.split(r"[^A-Za-z0-9._-]", one)[0] for one in wanted if "extra ==" not in one]
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if name in found:
            continue
        try:
            more = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        found.add(name)
        waiting += [re.split(r"[^A-Za-z0-9._-]", one)[0] for one in more if "extra ==" not in one]
    return found


HIDE = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hidden())
"""


USE = """
import contextlib, importlib, io, json, matplotlib, stimrig
from stimrig.api.cli import main
assert main.run(["fit", "data.csv", "-o", "M.json"]) == 0
assert main.run(["compare", "M.json", "data.csv", "--html", "c.html"]) == 0
for verb in ("diagnose", "explain", "improve", "invert", "predict", "table1", "effects", "schema"):
    importlib.import_module(f"stimrig.api.cli.commands.{verb}")
for name in stimrig.__all__:
    getattr(stimrig, name)
refused = {}
for verb in ("serve", "test", "demo", "doctor", "audit"):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.run([verb])
    refused[verb] = [code, out.getvalue(), err.getvalue()]
print(json.dumps(refused))
"""


@pytest.mark.slow
def test_the_base_install_identifies_and_names_the_extra_of_what_it_cannot(tmp_path: Path) -> None:
    """Where nothing is found but what `pip install stimrig` brings."""
    kept = closure(PROJECT["dependencies"])
    normal = {
        module: {re.sub(r"[-_.]+", "-", name).lower() for name in names}
        for module, names in importlib.metadata.packages_distributions().items()
    }
    hidden = {module for module, names in normal.items() if not names & (kept | {"stimrig"})}
    assert {"fastapi", "sqlalchemy", "can", "serial"} <= hidden and not hidden & {"numpy", "h5py", "numba"}
    (tmp_path / "sitecustomize.py").write_text(HIDE.format(modules=hidden))
    hidden_records.write_csv(hidden_records.patient_record(1), tmp_path / "data.csv")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", USE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "c.html").stat().st_size > 10_000
    for code, out, err in json.loads(done.stdout.splitlines()[-1]).values():
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "pip install 'stimrig[page]'" in err


def test_the_locked_list_of_a_rig_holds_base_and_page() -> None:
    pins = re.findall(r"^([a-z0-9._-]+)==", (ROOT / "requirements" / "run.txt").read_text(), re.M)
    wanted = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["page"]]
    assert {re.split(r"[^A-Za-z0-9._-]", one)[0] for one in wanted} <= set(pins)


# ---- containers -----------------------------------------------------------------------------------------------------


def test_the_container_is_nobodys_user_has_a_health_check_and_copies_what_a_build_needs() -> None:
    text = (ROOT / "deploy" / "Containerfile").read_text("utf-8")
    final = text.rpartition("\nFROM ")[2]
    assert "\nUSER stimrig\n" in final and "HEALTHCHECK" in final and "/health" in final
    copied = " ".join(re.findall(r"^COPY (?!--)(.*) \S+$", text, re.M)).split()
    assert {"pyproject.toml", "README.md", "LICENSE", "stimrig", "api", "rig", "identify", "hardware_sim"} <= set(
        copied
    )
    assert re.findall(r"\b[a-z0-9-]+\.(?:io|com|org)/", text) == [], "a registry's host"

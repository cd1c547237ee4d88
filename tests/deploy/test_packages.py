"""What is handed out: wheel and sdist, the Debian package's scripts in a root of their own, the container's file.

`make packages` builds and tries all of it; here is what takes seconds.
"""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Sequence
from email.parser import Parser
from pathlib import Path

import pytest
import yaml

from stimrig.api.cli.errors import PAGE
from stimrig.hardware_sim import hidden_records

ROOT = Path(__file__).parents[2]
DEB = ROOT / "deploy" / "deb"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
MOST_BYTES = 3 * 2**20


def built(source: Path, target: Path, umask: str) -> dict[str, bytes]:
    command = f'umask {umask}; exec "{sys.executable}" -m build --no-isolation -w -s -o "{target}" "{source}"'
    free = {name: value for name, value in os.environ.items() if name not in ("SOURCE_DATE_EPOCH", "PYTHONPATH")}
    answer = subprocess.run(["sh", "-c", command], capture_output=True, text=True, env=free)
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-2000:]
    return {path.name: path.read_bytes() for path in target.iterdir()}


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    folder = tmp_path_factory.mktemp("dist")
    built(ROOT, folder, "022")
    return folder


@pytest.mark.slow
def test_the_same_commit_gives_the_same_bytes_from_an_archive_and_from_its_sdist(dist: Path, tmp_path: Path) -> None:
    """From this checkout; from a copy that git knows nothing of, with another umask; and from the sdist."""
    first = {path.name: path.read_bytes() for path in dist.iterdir()}
    stamp = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True).stdout
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    packed = subprocess.run(["tar", "c", "--null", "-T", "-"], cwd=ROOT, input=listed, capture_output=True, check=True)
    other = tmp_path / "another place"
    other.mkdir()
    subprocess.run(["tar", "x", "-C", str(other)], input=packed.stdout, check=True)
    (other / "deploy" / "commit-time").write_text(stamp)  # as `git archive` does
    assert built(other, tmp_path / "second", "077") == first
    with tarfile.open(next(dist.glob("*.tar.gz"))) as sdist:
        sdist.extractall(tmp_path, filter="data")
    assert built(tmp_path / f"stimrig-{PROJECT['version']}", tmp_path / "third", "002") == first


def test_an_archive_of_git_tells_the_commits_time() -> None:
    assert (ROOT / "deploy" / "commit-time").read_text() == "$Format:%ct$\n"
    assert "deploy/commit-time export-subst" in (ROOT / ".gitattributes").read_text()


@pytest.mark.slow
def test_the_archives_hold_what_runs_and_nothing_else(dist: Path) -> None:
    wheel = zipfile.ZipFile(next(dist.glob("*.whl")))
    names = wheel.namelist()
    for package in ("", "api/", "rig/", "identify/", "hardware_sim/"):
        assert f"stimrig/{package}py.typed" in names
    assert {name.partition("/")[0] for name in names} == {"stimrig", f"stimrig-{PROJECT['version']}.dist-info"}
    assert [name for name in names if re.search(r"(^|/)(tests?|bench|__pycache__)/|\.pyc$", name)] == []
    tracked = subprocess.run(["git", "ls-files", "api", "rig", "identify", "hardware_sim"], cwd=ROOT,
                             capture_output=True, text=True, check=True).stdout.split()  # fmt: skip
    assert {name for name in tracked if (ROOT / name).is_file() and f"stimrig/{name}" not in names} == set()
    with tarfile.open(next(dist.glob("*.tar.gz"))) as sdist:
        inside = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"LICENSE", "CITATION.cff", "deploy/backend.py"} <= inside
    assert not {name for name in inside if name.startswith(("tests/", "bench/", "docs/"))}
    for path in dist.iterdir():
        assert path.stat().st_size <= MOST_BYTES


@pytest.mark.slow
def test_an_index_would_take_them(dist: Path) -> None:
    wheel = next(dist.glob("*.whl"))
    for command in (["check_wheel_contents", wheel], ["twine", "check", "--strict", *dist.iterdir()]):
        answer = subprocess.run([sys.executable, "-m", *map(str, command)], capture_output=True, text=True)
        assert answer.returncode == 0, answer.stdout + answer.stderr
    inside = zipfile.ZipFile(wheel)
    told = Parser().parsestr(inside.read(f"stimrig-{PROJECT['version']}.dist-info/METADATA").decode())
    assert (told["Version"], told["License-Expression"]) == (PROJECT["version"], "MIT")
    assert {"page", "centre", "cohort", "lsl", "files", "telemetry"} <= set(told.get_all("Provides-Extra") or [])
    assert "Typing :: Typed" in (told.get_all("Classifier") or []) and told["Keywords"]


def test_the_version_stands_once_and_is_cited() -> None:
    """What else tells a version takes the installed one: `api/version.py`, `identify/model.py`, the rig."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert cited["version"] == PROJECT["version"] and cited["license"] == PROJECT["license"]
    assert {"cff-version", "message", "title", "authors", "abstract", "date-released", "keywords"} <= cited.keys()
    assert cited["keywords"] == PROJECT["keywords"]
    pinned = re.search(r"^setuptools==(\S+)", (ROOT / "requirements" / "run.txt").read_text(), re.M)
    build = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["build-system"]
    assert pinned is not None and build["requires"] == [f"setuptools=={pinned[1]}"]


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


LOAD = """
import fpdf, importlib, stimrig
for verb in ("diagnose", "explain", "improve", "invert", "predict", "table1", "effects", "schema"):
    importlib.import_module(f"stimrig.api.cli.commands.{verb}")
for name in stimrig.__all__:
    getattr(stimrig, name)
"""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which nothing is found but what `pip install stimrig` brings."""
    kept = closure(PROJECT["dependencies"])
    normal = {
        module: {re.sub(r"[-_.]+", "-", name).lower() for name in names}
        for module, names in importlib.metadata.packages_distributions().items()
    }
    hidden = {module for module, names in normal.items() if not names & (kept | {"stimrig"})}
    assert PAGE - {"multipart"} <= hidden | {"python_multipart"} and not hidden & {"numpy", "h5py", "numba"}
    folder = tmp_path_factory.mktemp("base")
    (folder / "sitecustomize.py").write_text(HIDE.format(modules=hidden))
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "OPENBLAS_NUM_THREADS": "1"}


@pytest.mark.slow
def test_the_base_install_identifies_and_names_the_extra_of_what_it_cannot(
    base: dict[str, str], tmp_path: Path
) -> None:
    hidden_records.write_csv(hidden_records.patient_record(1), tmp_path / "data.csv")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "stimrig", *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=base, cwd=tmp_path)

    for verb in (["fit", "data.csv", "-o", "M.json"], ["compare", "M.json", "data.csv", "--html", "c.html"]):
        answer = run(*verb)
        assert answer.returncode == 0, answer.stderr
    assert (tmp_path / "c.html").stat().st_size > 10_000
    loaded = subprocess.run([sys.executable, "-c", LOAD], env=base, capture_output=True, text=True, cwd=tmp_path)
    assert loaded.returncode == 0, loaded.stderr
    for verb in ("serve", "test", "demo", "doctor", "audit", "centre"):
        answer = run(verb)
        assert answer.returncode == 2 and answer.stdout == "", answer
        assert "pip install 'stimrig[page]'" in answer.stderr and answer.stderr.count("\n") == 1, answer.stderr


def test_the_locked_list_of_a_rig_holds_base_and_page() -> None:
    pins = re.findall(r"^([a-z0-9._-]+)==", (ROOT / "requirements" / "run.txt").read_text(), re.M)
    wanted = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["page"]]
    assert {re.split(r"[^A-Za-z0-9._-]", one)[0] for one in wanted} <= set(pins)


# ---- the Debian package: its scripts in a root of their own, with commands that only tell ---------------------------


PLACES = (
    "etc/stimrig", "etc/systemd/system/multi-user.target.wants", "etc/udev/rules.d", "run/systemd/system",
    "usr/lib/stimrig/venv/bin", "usr/share/stimrig", "var/lib/stimrig/rig", "var/backups/stimrig", "var/cache/stimrig",
)  # fmt: skip


class FakeRoot:
    """A folder that stands for `/`, and stubs in the place of what talks to systemd."""

    def __init__(self, folder: Path) -> None:
        self.root, self.stubs, self.told = folder / "root", folder / "stubs", folder / "told"
        for place in PLACES:
            (self.root / place).mkdir(parents=True)
        self.stubs.mkdir()
        for name in ("systemctl", "deb-systemd-helper", "deb-systemd-invoke", "systemd-sysusers", "systemd-tmpfiles",
                     "udevadm", "chown"):  # fmt: skip
            self.stub(name, "exit 0")
        self.stub("install", 'while [ "$1" != "-g" ]; do shift; done; exec cp "$3" "$4"')
        (self.root / "usr/share/stimrig/rig.example.toml").write_text("# example\n")
        venv = self.root / "usr/lib/stimrig/venv/bin/python3"
        venv.write_text("#!/bin/sh\nexit 0\n")
        venv.chmod(0o755)

    def stub(self, name: str, does: str) -> None:
        path = self.stubs / name
        path.write_text(f'#!/bin/sh\necho "{name} $*" >>"{self.told}"\n{does}\n')
        path.chmod(0o755)

    def run(self, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        text = re.sub(r"(?<![\w.}$*])/(etc|usr|var|run|opt)\b", rf"{self.root}/\1", (DEB / script).read_text("utf-8"))
        path = os.pathsep.join([str(self.stubs), os.environ["PATH"]])
        return subprocess.run(["sh", "-c", text, script, *arguments], capture_output=True, text=True,
                              env={**os.environ, "PATH": path})  # fmt: skip


@pytest.fixture
def machine(tmp_path: Path) -> FakeRoot:
    return FakeRoot(tmp_path)


def test_settings_are_made_once_and_never_touched(machine: FakeRoot) -> None:
    assert machine.run("postinst", "configure").returncode == 0
    rig, token = machine.root / "etc/stimrig/rig.toml", machine.root / "etc/stimrig/api.env"
    assert rig.read_text() == "# example\n" and re.search(r"^STIMRIG_ADMIN_TOKEN=\S{40}", token.read_text(), re.M)
    assert token.stat().st_mode & 0o077 == 0
    rig.write_text("mine"), token.write_text("mine, too")
    assert machine.run("postinst", "configure", "0.9").returncode == 0
    assert (rig.read_text(), token.read_text()) == ("mine", "mine, too")


def test_an_upgrade_waits_for_a_test_and_starts_what_it_has_stopped(machine: FakeRoot) -> None:
    latch = machine.root / "var/lib/stimrig/rig/latch.json"
    latch.write_text('{"state": "running", "reason": ""}')
    refused = machine.run("prerm", "upgrade", "1.1")
    assert refused.returncode == 1 and "a test runs" in refused.stderr and "Traceback" not in refused.stderr
    assert "deb-systemd-invoke stop" not in machine.told.read_text()
    latch.write_text('{"state": "latched", "reason": "a person stopped it"}')
    machine.stub("systemctl", 'case "$*" in *centre*|*outbox*) exit 3 ;; esac')
    assert machine.run("prerm", "upgrade", "1.1").returncode == 0
    assert machine.run("postinst", "configure", "1.0.0").returncode == 0
    told = machine.told.read_text()
    assert "deb-systemd-invoke stop stimrig-api.service" in told and "stop stimrig-centre" not in told
    assert "deb-systemd-invoke start stimrig-api.service stimrig-rig.service" in told
    assert latch.read_text().startswith('{"state": "latched"'), "the rig stays stopped until a person re-arms it"


@pytest.mark.parametrize("aborted", ["abort-upgrade", "abort-remove"])
def test_what_could_not_be_done_leaves_the_services_running(machine: FakeRoot, aborted: str) -> None:
    machine.stub("systemctl", 'case "$*" in *centre*|*outbox*) exit 3 ;; esac')
    assert machine.run("prerm", "upgrade", "1.1").returncode == 0
    machine.stub("systemctl", 'case "$*" in *is-active*) exit 3 ;; esac')
    assert machine.run("prerm", "failed-upgrade", "1.0.0").returncode == 0, (
        "asked once more, when nothing runs any more"
    )
    assert machine.run("postinst", aborted, "1.1").returncode == 0
    assert "deb-systemd-invoke start stimrig-api.service stimrig-rig.service" in machine.told.read_text()


def test_a_first_installation_starts_nothing(machine: FakeRoot) -> None:
    assert machine.run("preinst", "install").returncode == 0
    assert machine.run("postinst", "configure").returncode == 0
    assert " start " not in machine.told.read_text()


def test_a_purge_takes_the_settings_and_keeps_what_is_of_people(machine: FakeRoot) -> None:
    kept = [machine.root / "var/lib/stimrig/rig/recording.h5", machine.root / "var/backups/stimrig/backup"]
    settings = machine.root / "etc/stimrig/rig.toml"
    for path in (*kept, settings):
        path.write_text("there")
    assert machine.run("postrm", "remove").returncode == 0 and settings.exists()
    purged = machine.run("postrm", "purge")
    assert purged.returncode == 0 and "kept:" in purged.stdout and purged.stdout.count("\n") == 1
    assert not settings.parent.exists() and all(path.read_text() == "there" for path in kept)


def test_what_an_older_installer_left_is_set_aside(machine: FakeRoot) -> None:
    units = machine.root / "etc/systemd/system"
    (units / "stimrig-rig.service").write_text("an old one")
    (units / "stimrig-outbox.service").symlink_to("/dev/null")
    wanted = units / "multi-user.target.wants/stimrig-rig.service"
    wanted.symlink_to(units / "stimrig-rig.service")
    assert machine.run("preinst", "install").returncode == 0
    assert (machine.root / "etc/stimrig/before-the-package/stimrig-rig.service").read_text() == "an old one"
    assert (units / "stimrig-outbox.service").is_symlink(), "a person has masked it"
    assert str(wanted.readlink()).endswith("usr/lib/systemd/system/stimrig-rig.service")


@pytest.mark.parametrize("name", ["preinst", "postinst", "prerm", "postrm"])
def test_a_maintainers_script_can_be_read_and_stops_at_an_error(name: str) -> None:
    subprocess.run(["sh", "-n", str(DEB / name)], check=True)
    assert "\nset -e\n" in (DEB / name).read_text("utf-8")
    assert os.access(DEB / name, os.X_OK)


def test_every_override_of_lintian_has_a_reason() -> None:
    lines = (DEB / "lintian-overrides").read_text("utf-8").splitlines()
    assert lines[0].startswith("# ") and all(re.match(r"# |stimrig: [a-z-]+ \*$", line) for line in lines)


# ---- containers -----------------------------------------------------------------------------------------------------


def backend_files() -> list[str]:
    """What the backend ships beside the package, read from its source: setuptools is not needed for that."""
    tree = ast.parse((ROOT / "deploy" / "backend.py").read_text("utf-8"))
    shipped = next(node.value for node in tree.body if isinstance(node, ast.Assign)
                   and ast.unparse(node.targets[0]) == "SHIPPED")  # fmt: skip
    assert isinstance(shipped, ast.Tuple)
    return [str(one.value) for one in shipped.elts if isinstance(one, ast.Constant)] + ["deploy/commit-time"]


def test_the_container_is_nobodys_user_has_a_health_check_and_copies_what_a_build_needs() -> None:
    text = (ROOT / "deploy" / "Containerfile").read_text("utf-8")
    final = text.rpartition("\nFROM ")[2]
    assert "\nUSER stimrig\n" in final and "HEALTHCHECK" in final and "/health" in final
    copied = " ".join(re.findall(r"^COPY (?!--)(.*) \S+$", text, re.M)).split()
    assert {"pyproject.toml", "README.md", "LICENSE", "CITATION.cff", "deploy/backend.py", "deploy/commit-time"} <= set(
        copied
    )
    assert {"stimrig", "api", "rig", "identify", "hardware_sim"} <= set(copied)
    assert re.findall(r"\b[a-z0-9-]+\.(?:io|com|org)/", text) == [], "a registry's host"


def test_the_centres_compose_file_holds_no_secret_and_no_right_too_many() -> None:
    text = (ROOT / "deploy" / "compose.yaml").read_text("utf-8")
    services = yaml.safe_load(text)["services"]
    for service in services.values():
        assert service["read_only"] is True and service["security_opt"] == ["no-new-privileges:true"]
        for name, value in service["environment"].items():
            if name.endswith(("PASSWORD", "TOKEN")):
                assert re.fullmatch(r"\$\{[A-Z_]+:\?.+\}", value), name
    assert services["centre"]["ports"] == ["127.0.0.1:8100:8100"] and services["centre"]["cap_drop"] == ["ALL"]
    assert "@database/" in services["centre"]["environment"]["STIMRIG_CENTRE_DATABASE_URL"]

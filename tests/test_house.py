"""The house keeps its own rules: what a linter doesn't see."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FIXED_TOP_LEVEL = {"pyproject.toml", "rig", "identify", "api", "hardware_sim", "tests", "deploy"}
BESIDE = {
    "README.md", "CONTRIBUTING.md", "Makefile", "stimrig", "docs", "examples", "bench", "requirements", "LICENSE",
    ".ci", ".containerignore", ".gitattributes", ".gitignore", ".pre-commit-config.yaml", "CHANGELOG.md",
    "CITATION.cff", "CODE_OF_CONDUCT.md", "SECURITY.md",
}  # fmt: skip


def tracked() -> list[Path]:
    listing = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listing.returncode:
        pytest.skip("not a git checkout")
    return [path for name in listing.stdout.splitlines() if (path := ROOT / name).is_file()]


def test_top_level_is_as_the_user_fixed_it() -> None:
    names = {path.relative_to(ROOT).parts[0] for path in tracked()}
    assert names >= FIXED_TOP_LEVEL
    assert names <= FIXED_TOP_LEVEL | BESIDE


def test_no_file_over_one_megabyte() -> None:
    assert [path for path in tracked() if path.stat().st_size > 1_000_000] == []


def test_no_registry_host_and_no_index_line_in_the_locked_lists() -> None:
    for name in ("run", "test", "bench"):
        text = (ROOT / "requirements" / f"{name}.txt").read_text()
        assert "://" not in text
        assert not re.search(r"^\s*--(extra-)?index|^\s*-i ", text, re.MULTILINE)
        pins = [line for line in text.splitlines() if re.match(r"[a-zA-Z0-9]", line)]
        assert pins
        assert len(pins) <= text.count("--hash=sha256:")


def test_nothing_in_the_lists_hides_our_packages() -> None:
    for name in ("run", "test", "bench"):
        pinned = re.findall(r"^([a-z0-9._-]+)==", (ROOT / "requirements" / f"{name}.txt").read_text(), re.MULTILINE)
        assert not {"identify", "rig", "api", "hardware-sim"} & set(pinned)


def test_no_machine_path_in_the_sources() -> None:
    pattern = re.compile(r"/(?:work|root|home/\w+)/")
    offenders = [
        f"{path.relative_to(ROOT)}: {found.group()}"
        for path in tracked()
        if path.suffix in {".py", ".md", ".toml", ".sh", ".yaml", ".html", ".js", ".css"} and path != Path(__file__)
        if (found := pattern.search(path.read_text(encoding="utf-8")))
    ]
    assert offenders == []


def test_the_emulator_and_identify_import_nothing_of_one_another_or_the_rig() -> None:
    """import-linter checks this too; this one also sees imports inside functions and by name."""
    forbidden = {
        "hardware_sim": ("rig", "identify", "api"),
        "identify": ("rig", "hardware_sim", "api"),
        "rig": ("identify", "hardware_sim", "api"),
    }
    for package, others in forbidden.items():
        names = "|".join(others)
        pattern = re.compile(
            rf"""^\s*from\s+stimrig\s+import\b.*\b(?:{names})\b|^\s*(?:from|import)\s+stimrig\.(?:{names})\b"""
            rf"""|import_module\(f?["']stimrig\.(?:{names})\b""", re.M,
        )  # fmt: skip
        for path in (ROOT / package).rglob("*.py"):
            assert not pattern.search(path.read_text(encoding="utf-8")), path


def test_no_private_name_crosses_modules_of_identify() -> None:
    """A name with an underscore belongs to its module; import-linter sees modules, not names."""
    offenders = []
    for path in sorted((ROOT / "identify").rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        imported = [alias for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names]
        modules = {alias.asname or alias.name for alias in imported}
        names = [alias.name for alias in imported]
        names += [
            node.attr
            for node in nodes
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules
        ]
        offenders += [f"{path.relative_to(ROOT)}: {name}" for name in names if name.startswith("_")]
    assert offenders == []


def test_the_segment_that_is_held_out_has_its_name_from_one_place() -> None:
    """Beside its constant it stands in the table of words for pages only, whose keys are names of segments."""
    found = {
        path.relative_to(ROOT).as_posix()
        for package in ("identify", "api")
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value == "validate"
    }
    assert found == {"identify/records/record.py", "api/clinical_words.py"}


def test_tests_import_nothing_from_the_benches() -> None:
    """What both need is in tests/harness."""
    pattern = re.compile(r"""^\s*(?:from|import)\s+bench\b|import_module\(["']bench\b""", re.M)
    found = [path for path in (ROOT / "tests").rglob("*.py") if pattern.search(path.read_text(encoding="utf-8"))]
    assert found == []


def test_a_test_of_no_cases_is_no_test(tmp_path: Path) -> None:
    """Many lists of cases are found by scanning a folder or a table."""
    (tmp_path / "test_none.py").write_text(
        "import pytest\n@pytest.mark.parametrize('case', [])\ndef test_it(case): assert case\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-c", ROOT / "pyproject.toml", "--rootdir", tmp_path, tmp_path]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, "Empty parameter set" in done.stdout) == (2, True), done.stdout

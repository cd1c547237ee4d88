"""`python -m tests`: a lane that fails, or that cannot be followed, is never lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.__main__ import run


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_each_lane_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "test_good.py").write_text("def test_it(): pass")
    (tmp_path / "test_bad.py").write_text("def test_it(): assert 1 == 2")
    failures: list[str] = []
    lanes = {name: (str(tmp_path / f"test_{name}.py"), "-c", "/dev/null") for name in ("good", "bad", "empty")}
    codes = run(lanes | {"lost": ("\0",)}, failures)  # no program takes such an argument
    assert codes == {"good": 0, "bad": 1, "empty": 4, "lost": 1}
    told = [line for line in failures if line.startswith("[bad] ")]
    assert any("assert 1 == 2" in line for line in told)
    assert any("FAILED" in line for line in told)
    assert "[good] " in capsys.readouterr().out

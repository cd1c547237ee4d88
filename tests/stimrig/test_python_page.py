"""docs/python.md does what it says: its blocks are run in order, against a served app; its table names every name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import stimrig
from tests.api.conftest import TOKEN, Service
from tests.api.test_worker import made_up_csv
from tests.harness import few_effects

TEXT = (Path(__file__).parents[2] / "docs" / "python.md").read_text("utf-8")


@pytest.mark.slow
def test_every_block_runs_in_order(tmp_path: Path, service: Service) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 9
    scope = {"path": made_up_csv(tmp_path / "record.csv"), "url": service.url, "token": TOKEN}
    with few_effects.only("threshold_drift", "recruitment_hysteresis", "fatigue"):
        for block in blocks:
            exec(compile(block, "python.md", "exec"), scope)


def test_the_page_names_everything() -> None:
    for name in stimrig.__all__:
        assert re.search(rf"`(stimrig\.)?{name}\b", TEXT), name
    methods = {name for name in vars(stimrig.Client) | vars(stimrig.Client.__base__) if not name.startswith("_")}
    missing = {name for name in methods if not re.search(rf"\b{name}\b", TEXT)}
    assert missing <= {"issue_token", "model_file", "participant", "tests", "test", "ensure_participant"}

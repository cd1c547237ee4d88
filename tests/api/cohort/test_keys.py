"""A scheduler on this machine opens to who started it, and to nobody else."""

from __future__ import annotations

import importlib.util

import pytest

from api.cohort.cluster import Workers, connected
from api.cohort.errors import CohortError


def test_without_keys_no_scheduler_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "cryptography" else find(name))
    with pytest.raises(CohortError, match="pip install cryptography"), connected(Workers(count=1)):
        pass

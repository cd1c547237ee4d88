"""The emulated rig as processes, at the speed of the world: then a pause of the machine is as long to the devices."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.harness.processes import Bench, RigClient, made_ready


@pytest.fixture
def make_bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Start an emulator with options; it and its rig end with the test."""
    benches: list[Bench] = []

    def make(*options: str) -> Bench:
        benches.append(Bench(tmp_path / f"bench{len(benches)}", *options))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One emulator of the paper's patient for a whole file."""
    bench = Bench(tmp_path_factory.mktemp("shared"), "--noise-seed", "7")
    yield bench
    bench.close()


@pytest.fixture
def shared(emulator: Bench) -> tuple[Bench, RigClient]:
    """The file's emulator with a ready rig: what one test left behind is no other test's failure."""
    lives = emulator.rig is not None and emulator.rig.popen.poll() is None
    client = emulator.client() if lives else emulator.start_rig()
    if client.status()["state"] == "uncertain":
        client.rearm("test")
    return made_ready(emulator, client)

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

    def make(*options: str, speed: float = 1.0) -> Bench:
        bench = Bench(tmp_path / f"bench{len(benches)}", *options, speed=speed)
        benches.append(bench)
        return bench

    yield make
    for bench in benches:
        bench.close()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bench, RigClient]]:
    """One emulator and one rig for a whole file."""
    bench = Bench(tmp_path_factory.mktemp("shared"), "--noise-seed", "7")
    yield bench, bench.start_rig()
    bench.close()


@pytest.fixture
def shared(pair: tuple[Bench, RigClient]) -> tuple[Bench, RigClient]:
    """The file's pair, ready: what one test left behind is no other test's failure."""
    return made_ready(*pair)


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    """An emulator of the paper's patient."""
    return make_bench("--noise-seed", "7")

"""The same behaviour on every kind of device: one pair in each run, all of them in a campaign."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import pytest

from tests.harness.device_pairs import CELLS, HOLD, STIMULATORS, TRANSPORTS, check_all, options
from tests.harness.processes import Bench, kill_hard, short_plan

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

MOST = {
    "align_ms": 1.0,
    "ack_ms": 10.0,
    "stop_ms": 100.0,
    "fault_ms": 250.0,
    "silence_ms": 30.0,
    "dropped_percent": 10.0,
}
"""Bounds of the figures of a pair, on a machine that does nothing else."""


def test_a_pair_behaves(make_bench: Callable[..., Bench]):
    # at the speed of the world: a backlog of text frames is read hardly faster than twice that
    check_all(make_bench(*options("rehastim2", "canopen", "slcan")))


@pytest.mark.campaign
@pytest.mark.parametrize("pair", list(itertools.product(STIMULATORS, CELLS, TRANSPORTS)), ids=" ".join)
def test_every_pair_behaves(make_bench: Callable[..., Bench], pair: tuple[str, str, str]):
    figures = check_all(make_bench(*options(*pair), speed=1.0))
    over = {name: figures[name] for name, most in MOST.items() if not figures[name] <= most}
    assert not over


def test_a_rehastim2_is_kept_alive_through_a_rest_and_lets_go_of_a_dead_host(make_bench: Callable[..., Bench]):
    """Its watchdog strikes 1200 ms after the last command: the bound of its silence, here with single pulses."""
    bench = make_bench("--stimulator", "rehastim2")
    client = bench.start_rig()
    client.ask("subscribe")
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 3.0}}
    assert client.start(short_plan("rests", segments=[rest, *HOLD[1:], rest]))["ok"]
    client.wait_state("running")
    while len(bench.felt()) < 20:
        time.sleep(0.02)
    commands = bench.state()["commands"]
    assert 5 <= commands["4"] <= 12  # 3 s of rest, a keep-alive each 0.3 s
    assert bench.rig is not None
    alive_s = bench.state()["time_s"]
    kill_hard(bench.rig)
    died_s = bench.state()["time_s"]
    asleep_s = [died_s]  # when the device was last seen connected, on its own clock
    while (now := bench.state())["mode"] != "none":
        assert now["time_s"] - died_s < 10
        asleep_s.append(now["time_s"])
        time.sleep(0.01)
    assert asleep_s[-1] - died_s <= 1.2 and now["time_s"] - alive_s >= 0.9  # a keep-alive each 0.3 s before
    assert sum(pulse["time_s"] > died_s for pulse in bench.felt()) <= 1  # a command may have been on its way

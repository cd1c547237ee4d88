"""The same behaviour on every kind of device: some pairs here, all of them in `python -m bench.rig_pairs`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.harness.device_pairs import HOLD, check_all, felt, options
from tests.harness.processes import Bench, control, kill_hard, short_plan

pytestmark = pytest.mark.wire

PAIRS = [
    ("p24", "plain x3", "slcan"),
    ("p24", "counts", "socketcand"),
    ("rehastim2", "canopen", "slcan"),
]


@pytest.mark.realtime
@pytest.mark.parametrize(("stimulator", "cell", "transport"), PAIRS)
def test_a_pair_behaves(make_bench: Callable[..., Bench], stimulator: str, cell: str, transport: str):
    # at the speed of the world: a backlog of text frames is read hardly faster than twice that
    figures = check_all(make_bench(*options(stimulator, cell, transport), speed=1.0))
    assert figures["stop_ms"] < 100


def test_a_rehastim2_is_kept_alive_through_a_rest_and_lets_go_of_a_dead_host(make_bench: Callable[..., Bench]):
    """Its watchdog strikes 1200 ms after the last command: the bound of its silence, here with single pulses."""
    bench = make_bench("--stimulator", "rehastim2", speed=2.0)
    client = bench.start_rig()
    client.ask("subscribe")
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 3.0}}
    assert client.start(short_plan("rests", segments=[rest, *HOLD[1:], rest]))["ok"]
    client.wait_state("running")
    while len(felt(bench)) < 20:
        time.sleep(0.02)
    commands = state(bench)["commands"]
    assert 5 <= commands["4"] <= 12  # 3 s of rest, a keep-alive each 0.3 s
    died_s = time.monotonic()
    assert bench.rig is not None
    kill_hard(bench.rig)
    while state(bench)["mode"] != "none":
        assert time.monotonic() - died_s < 5
        time.sleep(0.01)
    assert 1.0 < (time.monotonic() - died_s) * bench.speed < 1.6
    assert felt(bench)[-1]["monotonic_s"] - died_s < 0.03


def state(bench: Bench) -> dict[str, Any]:
    return control(bench.emulator.ready["control"], {"cmd": "state"})

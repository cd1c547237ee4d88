"""What talks to a centre has no way to the rig: nothing that a centre answers can move current."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.api.conftest import PATIENCE_S
from tests.api.outbox.rigs import Rig
from tests.api.outbox.test_process import ROOT, serving
from tests.harness.fake_centre import KEY, BadLine, FakeCentre

LOADED = """
import stimrig.api.outbox.__main__, sys
apart = ("stimrig.rig.", "stimrig.api.sessions.", "stimrig.api.web.")
print([name for name in sys.modules if f"{name}.".startswith(apart)])
"""


def test_it_loads_nothing_that_could_speak_to_the_rig() -> None:
    done = subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.slow
def test_whatever_a_centre_answers_nobody_comes_to_the_rigs_socket(tmp_path: Path, short_dir: Path) -> None:
    """Even where the rig's socket is named in its environment, as the service's is."""
    rig, line = Rig(tmp_path), BadLine(FakeCentre(), random.Random(1), 0.5, rubbish=True)
    rig.participant("P1")
    place = short_dir / f"rig-{time.time_ns()}.sock"
    with socket.socket(socket.AF_UNIX) as listener, serving(line) as url:
        listener.bind(str(place))
        listener.listen()
        listener.setblocking(False)
        environment = {
            **os.environ, "STIMRIG_DATA_DIR": str(tmp_path), "STIMRIG_CENTRE_URL": url, "STIMRIG_CENTRE_KEY": KEY,
            "STIMRIG_RIG_SOCKET": str(place),
        }  # fmt: skip
        with (tmp_path / "outbox.log").open("ab") as log:
            running = subprocess.Popen(
                [sys.executable, "-m", "stimrig.api.outbox"], cwd=ROOT, env=environment, stderr=log
            )
        try:
            end = time.monotonic() + 2 * PATIENCE_S
            while line.requests < 4:  # it waits for real, longer each time
                assert time.monotonic() < end and running.poll() is None
                time.sleep(0.05)
            with pytest.raises(BlockingIOError):
                listener.accept()
        finally:
            running.send_signal(signal.SIGKILL)
            running.wait()
    rig.close()

"""`python -m stimrig.api.outbox` as a process: killed at any moment it goes on; wrong settings; who starts it."""

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

from stimrig.api.cli import launcher
from stimrig.api.cli.commands.doctor import check_centre
from stimrig.api.cli.launcher import Services
from stimrig.api.errors import SettingsError
from stimrig.api.outbox import status
from stimrig.api.outbox.status import Status
from stimrig.api.settings import Settings
from stimrig.api.store.tables import OutboxItem
from tests.api.conftest import PATIENCE_S, STUB, run_service
from tests.api.outbox.conftest import Rig, assert_told
from tests.harness.fake_centre import KEY, BadLine, FakeCentre
from tests.harness.http_double import answering

ROOT = Path(__file__).parents[3]


def start(folder: Path, url: str) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "STIMRIG_DATA_DIR": str(folder), "STIMRIG_CENTRE_URL": url, "STIMRIG_CENTRE_KEY": KEY}
    with (folder / "outbox.log").open("ab") as log:
        return subprocess.Popen([sys.executable, "-m", "stimrig.api.outbox"], cwd=ROOT, env=environment, stderr=log)


def everything_over(rig: Rig, centre: FakeCentre) -> bool:
    """Whether the centre stands where the rig does, and has every file."""
    newest = rig.items()[-1]
    stands = centre.place(newest.chain)["hash"] == newest.hash
    return stands and not centre.wanted(1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in (2, 3, 4))])
def test_killed_at_random_it_loses_and_doubles_nothing(tmp_path: Path, seed: int) -> None:
    """SIGKILL while it reads, sends and waits, on a line that often fails; it waits for real, longer each time."""
    rig, chance = Rig(tmp_path, seed=seed), random.Random(seed)
    line = BadLine(FakeCentre(), chance, 0.25)
    rig.participant("P1")
    with answering(line) as url:
        for _ in range(3):
            rig.session("P1", size=chance.choice((1000, 9_000_000)))
            seen = line.requests
            running = start(tmp_path, url)
            try:
                end = time.monotonic() + PATIENCE_S
                wanted = seen + chance.randrange(1, 8)
                while line.requests < wanted and not everything_over(rig, line.centre):
                    assert time.monotonic() < end and running.poll() is None
                    time.sleep(0.01)
                time.sleep(chance.random() * 0.05)  # somewhere between two requests
            finally:
                running.send_signal(signal.SIGKILL)
                running.wait()
        line.harm = 0.0
        running = start(tmp_path, url)
        try:
            end = time.monotonic() + 2 * PATIENCE_S
            while not everything_over(rig, line.centre):
                assert time.monotonic() < end and running.poll() is None, (tmp_path / "outbox.log").read_text()
                time.sleep(0.05)
        finally:
            running.terminate()
            running.wait(PATIENCE_S)
    assert_told(rig, line.centre)
    assert len(line.centre.newest("recording")) == 3
    rig.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "names no centre"),
        ({"STIMRIG_CENTRE_URL": "http://centre.example.org", "STIMRIG_CENTRE_KEY": "k"}, "not sent in the clear"),
        ({"STIMRIG_CENTRE_URL": "https://centre.example.org"}, "give the key"),
    ],
    ids=["none", "clear", "no-key"],
)
def test_a_wrong_setting_is_one_line_and_exit_code_2(tmp_path: Path, given: dict[str, str], words: str) -> None:
    environment = {**os.environ, "STIMRIG_DATA_DIR": str(tmp_path), **given}
    command = [sys.executable, "-m", "stimrig.api.outbox"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    lines = done.stderr.splitlines()
    assert done.returncode == 2 and len(lines) == 1 and words in lines[0], done.stderr


@pytest.mark.slow
def test_it_makes_no_database_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STIMRIG_DATABASE_URL", raising=False)
    running = start(tmp_path, "http://127.0.0.1:9")
    assert running.wait(PATIENCE_S) == 1
    assert "start the service first" in (tmp_path / "outbox.log").read_text()
    assert not (tmp_path / "stimrig.db").exists()


@pytest.mark.parametrize(
    ("url", "key", "words"),
    [
        ("http://10.0.0.1", KEY, "in the clear"),
        ("centre.example.org", KEY, "no address"),
        ("https://user:pass@centre.example.org", KEY, "no address"),
        ("https://:user:pass@centre.example.org", KEY, "no address"),
        (" https://centre.example.org", KEY, "no address"),
        ("https://centre.example.org\n", KEY, "no address"),
        ("https://centre.example.org#rigs", KEY, "no address"),
        ("https://centre.example.org:99999", KEY, "Port out of range"),
        ("https://centre.example.org", "key two", "no spaces"),
        ("https://centre.example.org", "ключ", "no spaces"),
        ("https://centre.example.org", "", "give the key"),
        (None, KEY, "set STIMRIG_CENTRE_URL, too"),
        ("", KEY, "set STIMRIG_CENTRE_URL, too"),
    ],
)
def test_settings_that_do_not_hold_are_refused_and_no_key_is_shown(url: str | None, key: str, words: str) -> None:
    with pytest.raises(SettingsError, match=words) as refused:
        Settings(centre_url=url, centre_key=key)  # pyright: ignore[reportArgumentType]
    said = str(refused.value)
    assert "\n" not in said and "user:pass" not in said and (not key or key not in said)


@pytest.mark.parametrize("url", ["https://centre.example.org/rigs/", "http://127.0.0.1:8001", "http://[::1]:8001"])
def test_settings_that_hold(url: str) -> None:
    made = Settings(centre_url=url, centre_key=KEY)  # pyright: ignore[reportArgumentType]
    assert made.centre_url == url.rstrip("/") and KEY not in repr(made)


# ---- who starts it ------------------------------------------------------------------------------------------------


def test_without_a_centre_the_launcher_starts_no_outbox(tmp_path: Path) -> None:
    services = Services(Settings(data_dir=tmp_path))
    assert services.outbox is None
    services.stop()


def test_an_outbox_that_dies_is_started_again_and_ends_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launcher, "OUTBOX_RESTART_S", (0.0, 0.0, 3600.0))
    given = {"data_dir": tmp_path, "centre_url": "http://127.0.0.1:9", "centre_key": KEY}
    services = Services(Settings(**given))  # pyright: ignore[reportArgumentType]
    child = services.outbox
    assert child is not None
    child.command = [sys.executable, "-c", "import sys; print('outbox: on purpose', file=sys.stderr); sys.exit(2)"]
    child.start_unheard()
    events: list[str] = []
    for _ in range(2):
        assert child.process is not None
        child.process.wait(PATIENCE_S)
        events += services._keep_telling()
    assert len(events) == 2 and all("on purpose" in event for event in events)
    child.process.wait(PATIENCE_S)
    assert services._keep_telling() == [], "not before its time"
    services.stop()
    child.command = ["/nowhere/at/all"]
    child.start_unheard()  # says nothing and raises nothing


# ---- what people see ----------------------------------------------------------------------------------------------


def told(folder: Path, state: str, **more: object) -> None:
    now = "2026-11-23T10:00:00.000Z"
    made = Status(state, "a line of words", "http://127.0.0.1:9", now, "2999-01-01T00:00:00.000Z", now)
    status.write(folder, Status(**{**made.__dict__, **more}))  # pyright: ignore[reportArgumentType]


def test_page_metrics_and_doctor_say_how_it_goes(tmp_path: Path, short_dir: Path) -> None:
    given = {"centre_url": "http://127.0.0.1:9", "centre_key": KEY}
    for service in run_service(tmp_path, short_dir, STUB, **given):
        with service.client() as http:
            page = http.get("/administration").text
            assert "Nothing is being sent" in page and "never" in page
            told(tmp_path, "unreachable", items_waiting=1234, files_waiting=56, damaged=("ab" * 32,), damaged_count=1)
            page = http.get("/administration").text
            assert "cannot be reached" in page and "1234" in page and "56" in page and "abababababab…" in page
            german = http.get("/administration", headers={"Accept-Language": "de"}).text
            assert "Die Zentrale ist nicht erreichbar." in german
            figures = http.get("/metrics").text
            assert "stimrig_outbox_items_waiting 1234.0" in figures and "stimrig_outbox_files_waiting 56.0" in figures
            assert "stimrig_outbox_contact_age_seconds " in figures
            assert http.post("/v1/participants", json={"code": "P1"}).status_code == 201
        kinds = [item.kind for item in service.context.store.all(OutboxItem)]
        assert "participant" in kinds and "audit" in kinds
        finding = next(check_centre(service.context.settings))
        assert finding.verdict == "care" and "1234 items and 56 files wait" in finding.says


def test_without_a_centre_nothing_is_shown_and_nothing_grows(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, STUB):
        with service.client() as http:
            http.post("/v1/participants", json={"code": "P1"})
            assert 'id="centre"' not in http.get("/administration").text
            assert "stimrig_outbox" not in http.get("/metrics").text
        assert service.context.store.all(OutboxItem) == []
        assert list(check_centre(service.context.settings)) == []


# ---- What talks to a centre has no way to the rig: nothing that a centre answers can move current


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
    with socket.socket(socket.AF_UNIX) as listener, answering(line) as url:
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

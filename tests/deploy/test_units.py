"""Units, udev rules and the installer: the rights that the risk file speaks of, and names that agree."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from stimrig.api.cli.supervisor import SEAL_S
from stimrig.rig.__main__ import BEAT_PERIOD_S, PROCESS_PRIORITY
from stimrig.rig.adapters.machine import PRIORITY

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
RULES = (DEPLOY / "udev" / "70-stimrig.rules").read_text("utf-8")


def unit(name: str) -> dict[str, list[str]]:
    """A unit's settings; every setting is a list, as systemd allows."""
    found: dict[str, list[str]] = {}
    for line in (DEPLOY / "systemd" / name).read_text("utf-8").splitlines():
        key, sign, value = line.partition("=")
        if sign and not line.startswith("#"):
            found.setdefault(key.strip(), []).append(value.strip())
    return found


RIG, API = unit("stimrig-rig.service"), unit("stimrig-api.service")


@pytest.mark.parametrize("name", [f"stimrig-{name}.service" for name in ("rig", "api", "backup")])
def test_no_service_has_more_rights_than_it_needs(name: str) -> None:
    settings = unit(name)
    assert settings["User"] != ["root"]
    assert settings["CapabilityBoundingSet"] == [""]
    for key in ("NoNewPrivileges", "ProtectHome", "PrivateTmp", "RestrictNamespaces", "LockPersonality"):
        assert settings[key] == ["yes"], key
    assert settings["ProtectSystem"] == ["strict"]
    assert settings["SystemCallFilter"] == ["@system-service"]


def test_the_service_reaches_no_device_and_none_of_the_rigs_files() -> None:
    assert API["User"] != RIG["User"]
    assert API["Group"] == RIG["Group"]
    assert API["PrivateDevices"] == ["yes"]
    assert API["RestrictRealtime"] == ["yes"]
    assert "DeviceAllow" not in API
    assert API["ReadWritePaths"] == ["/var/lib/stimrig/api"]
    assert API["BindReadOnlyPaths"][0].startswith("/var/lib/stimrig/rig/recordings:")
    assert "AF_CAN" not in API["RestrictAddressFamilies"][0]


def test_the_rig_reaches_its_devices_and_no_network() -> None:
    assert RIG["DevicePolicy"] == ["closed"]
    assert RIG["DeviceAllow"] == ["char-ttyACM rw", "char-ttyUSB rw"]
    assert set(RIG["RestrictAddressFamilies"][0].split()) == {"AF_UNIX", "AF_CAN"}
    assert RIG["IPAddressDeny"] == ["any"]
    assert RIG["ReadWritePaths"] == ["/var/lib/stimrig/rig"]


def test_the_rig_may_take_the_priorities_that_it_asks_for() -> None:
    assert int(RIG["LimitRTPRIO"][0]) >= max(PRIORITY, PROCESS_PRIORITY)
    assert "RestrictRealtime" not in RIG
    assert (RIG["CPUSchedulingPolicy"], int(RIG["CPUSchedulingPriority"][0])) == (["rr"], PROCESS_PRIORITY)


def test_a_stop_of_the_unit_leaves_time_to_seal_and_a_crash_is_followed_by_a_start() -> None:
    assert int(RIG["TimeoutStopSec"][0]) > SEAL_S
    for settings in (RIG, API):
        assert settings["Restart"] == ["always"]
        assert settings["RestartPreventExitStatus"] == ["2"]


def test_a_rig_that_hangs_is_found_and_one_that_is_busy_is_let_be() -> None:
    """What the process sends: tests/rig/test_process.py."""
    assert (RIG["Type"], RIG["NotifyAccess"]) == (["notify"], ["main"])
    assert 10 * BEAT_PERIOD_S < int(RIG["WatchdogSec"][0]) <= 60
    assert "AF_UNIX" in RIG["RestrictAddressFamilies"][0].split()


def test_both_speak_of_the_same_socket_and_folders() -> None:
    command = RIG["ExecStart"][0]
    socket = re.search(r"--socket (\S+)", command)
    assert socket is not None
    assert f"STIMRIG_RIG_SOCKET={socket[1]}" in " ".join(API["Environment"])
    assert Path(socket[1]).parent == Path("/run") / RIG["RuntimeDirectory"][0]
    assert RIG["RuntimeDirectoryMode"] == ["0750"]
    tmpfiles = (DEPLOY / "systemd" / "stimrig.tmpfiles.conf").read_text("utf-8")
    made = {line.split()[1]: line.split()[2:5] for line in tmpfiles.splitlines() if line.startswith("d ")}
    assert made["/var/lib/stimrig/rig"] == ["0750", RIG["User"][0], RIG["Group"][0]]
    assert made["/var/lib/stimrig/api"] == ["0700", API["User"][0], API["Group"][0]]
    for folder in (*RIG["ReadWritePaths"], *API["ReadWritePaths"], *API["BindReadOnlyPaths"][0].split(":")):
        assert folder in made


def test_a_token_drawn_at_the_first_start_is_not_in_the_journal() -> None:
    assert API["StandardOutput"] == ["null"]


def test_devices_belong_to_the_rigs_user_alone() -> None:
    port = tomllib.loads((DEPLOY / "rig.example.toml").read_text("utf-8"))["stimulator"]["port"]
    rules = [line for line in RULES.splitlines() if line.startswith('SUBSYSTEM=="tty"')]
    assert any('"0483"' in rule and f'SYMLINK+="{port.removeprefix("/dev/")}"' in rule for rule in rules)
    for rule in rules:
        assert f'OWNER="{RIG["User"][0]}"' in rule
        assert 'MODE="0600"' in rule
        assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in rule
    assert 'DRIVER=="ftdi_sio", ATTR{latency_timer}="1"' in RULES


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_knows_every_setting(tmp_path: Path) -> None:
    """Unknown settings and wrong values; that programs are not installed here is not its matter."""
    for path in (DEPLOY / "systemd").glob("stimrig*.*"):
        if path.suffix in (".service", ".timer"):
            text = re.sub(r"/usr/lib/stimrig/venv/bin/python3", "/bin/true", path.read_text("utf-8"))
            (tmp_path / path.name.replace("@", "@can0")).write_text(text.replace("%i", "can0"))
    units = [str(path) for path in tmp_path.iterdir()]
    answer = subprocess.run(["systemd-analyze", "verify", "--man=no", *units], capture_output=True, text=True)
    ours = [line for line in answer.stderr.splitlines() if "stimrig" in line and "not executable" not in line]
    assert ours == []


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("name", sorted(path.name for path in (DEPLOY / "systemd").glob("*.service")))
def test_no_unit_is_exposed(name: str, tmp_path: Path) -> None:
    """An exposure of at most 2.0, and a unit that asks for nothing is over it."""
    hardened, bare = tmp_path / name.replace("@", "@can0"), tmp_path / "bare.service"
    hardened.write_text((DEPLOY / "systemd" / name).read_text("utf-8"), "utf-8")
    bare.write_text("[Service]\nExecStart=/bin/true\n", "utf-8")
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=20"]
    answer = subprocess.run([*command, str(hardened)], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout.splitlines()[-1:]
    assert subprocess.run([*command, str(bare)], capture_output=True).returncode == 1


def test_what_brings_the_cells_interface_up_may_do_no_more() -> None:
    settings = unit("stimrig-can@.service")
    assert settings["CapabilityBoundingSet"] == ["CAP_NET_ADMIN"]
    assert "AF_NETLINK" in settings["RestrictAddressFamilies"][0] and settings["PrivateDevices"] == ["yes"]
    assert 'KERNEL=="can0", TAG+="systemd", ENV{SYSTEMD_WANTS}+="stimrig-can@can0.service"' in RULES


def test_the_installer_is_sound_and_changes_nothing_in_a_dry_run() -> None:
    script = DEPLOY / "install.sh"
    subprocess.run(["bash", "-n", str(script)], check=True)
    assert subprocess.run([str(script), "--nonsense"], capture_output=True).returncode == 2
    if not Path("/etc/debian_version").exists():
        pytest.skip("the dry run wants a Debian machine")
    before = Path("/usr/lib/stimrig").exists(), Path("/etc/stimrig").exists()
    answer = subprocess.run([str(script), "--dry-run"], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    put = {line.rpartition(" ")[2] for line in answer.stdout.splitlines() if line.startswith("would: install -D")}
    units = {path.name for path in (DEPLOY / "systemd").iterdir() if path.suffix in (".service", ".timer")}
    assert {f"/etc/systemd/system/{name}" for name in units} < put and "/etc/udev/rules.d/70-stimrig.rules" in put
    assert (Path("/usr/lib/stimrig").exists(), Path("/etc/stimrig").exists()) == before

"""`stimrig doctor`: check what this machine needs for a rig, and say how to fix what is missing."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from stimrig.api.cli.commands.audit import stored
from stimrig.api.cli.commands.serve import rig_status
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.options import DataDir, Json, set_options
from stimrig.api.cli.terminal import report
from stimrig.api.errors import ApiError
from stimrig.api.settings import Settings
from stimrig.api.store import audit

Verdict = Literal["ok", "care", "fails"]
VERDICTS: tuple[Verdict, ...] = ("ok", "care", "fails")
LEAST_FREE_GB, GOOD_FREE_GB = 0.5, 5.0
RIGHTS = (
    ("priority", "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))",
     "this user's programs may run before all others", "LimitRTPRIO=60", "rtprio 60"),
    ("memory", "import ctypes, sys; sys.exit(-ctypes.CDLL(None).mlockall(7))",
     "this user may lock memory: what is read back from the disk makes a pulse late",
     "LimitMEMLOCK=infinity", "memlock unlimited"),
)  # fmt: skip
"""The check's name, a program that needs the right, what the right is, and the lines that grant it."""


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str
    verdict: Verdict
    """`fails`: a test would be refused or lost. `care`: it works, but not as it should."""
    says: str
    fix: str = ""


def examine(settings: Settings) -> list[Finding]:
    """Run all checks in the order in which they are written; one that raises an error is a finding, too."""
    findings: list[Finding] = []
    for name, check in globals().items():
        if name.startswith("check_"):
            try:
                findings += check(settings)
            except Exception as error:
                text = f"could not be checked: {type(error).__name__}: {error}"
                findings.append(Finding(name.removeprefix("check_"), "care", text))
    return findings


def check_rig_file(settings: Settings) -> Iterator[Finding]:
    """Read the rig file with the rig's own reader, in a process of its own; look for its port and its bus."""
    if settings.rig_file is None:
        yield Finding("rig file", "ok", "none given: the emulated rig will be used")
        return
    code = "import sys, pathlib; from stimrig.rig import config; config.load(pathlib.Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(settings.rig_file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it cannot be read"])[-1]
        yield Finding("rig file", "fails", last.rpartition("Error: ")[2], "docs/rig-file.md lists every key")
        return
    yield Finding("rig file", "ok", f"{settings.rig_file}: every key is valid")
    content = tomllib.loads(settings.rig_file.read_text("utf-8"))
    if port := content["stimulator"].get("port"):
        yield examine_port("stimulator", Path(port))
    bus = content["load_cell"].get("bus") or {}
    if bus.get("interface") == "slcan":
        yield examine_port("load cell", Path(str(bus.get("channel")).partition("@")[0]))
    if bus.get("interface") == "socketcan":
        yield examine_interface(str(bus.get("channel")))


def examine_port(device: str, port: Path) -> Finding:
    """Check a serial port."""
    rights = "add this user to the port's group (dialout), or install deploy/udev/70-stimrig.rules; sign in again"
    if not port.exists():
        fix = "plug it in and switch it on; `ls -l /dev/serial/by-id` shows what is there"
        return Finding(device, "fails", f"{port} is not there", fix)
    if not port.is_char_device():
        return Finding(device, "fails", f"{port} is no serial port", "give its name under /dev in the rig file")
    if not os.access(port, os.R_OK | os.W_OK):
        return Finding(device, "fails", f"{port} may not be read and written by this user", rights)
    return Finding(device, "ok", f"{port} is there and may be used")


def examine_interface(channel: str) -> Finding:
    """Check that a CAN interface is up."""
    flags = Path("/sys/class/net") / channel / "flags"
    up = flags.exists() and int(flags.read_text(), 16) & 1
    says = f"{channel} is {'up' if up else 'down'}" if flags.exists() else f"there is no interface {channel}"
    fix = f"plug the adapter in; systemctl start stimrig-can@{channel} brings it up"
    return Finding("load cell", "ok" if up else "fails", says, fix)


def check_rig(settings: Settings) -> Iterator[Finding]:
    """Check that the rig's process answers, and is not latched."""
    if settings.rig_socket is None:
        return
    try:
        status = rig_status(settings.rig_socket)
    except ApiError as error:
        yield Finding("rig", "fails", str(error), "systemctl status stimrig-rig; its journal says why")
        return
    fails = status.state in ("latched", "uncertain", "disconnected")
    fix = "check the participant and the rig, then re-arm it on the page"
    yield Finding("rig", "fails" if fails else "ok", f"{status.state}: {status.reason}" if fails else status.state, fix)


def check_data(settings: Settings) -> Iterator[Finding]:
    """Check the data folder: writable, closed to others, with room."""
    folder = settings.data_dir.absolute()
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    if not os.access(nearest, os.W_OK | os.X_OK):
        fix = f"chown it to this user, or set STIMRIG_DATA_DIR; deploy/install.sh makes {folder} as it should be"
        yield Finding("data folder", "fails", f"{nearest} may not be written by this user", fix)
        return
    if folder.exists() and folder.stat().st_mode & stat.S_IROTH:
        yield Finding("data folder", "care", f"{folder} may be read by every user", f"chmod o-rwx {folder}")
    else:
        yield Finding("data folder", "ok", f"{folder} may be written, by this user and its group")
    free_gb = shutil.disk_usage(nearest).free / 1e9
    verdict = "fails" if free_gb < LEAST_FREE_GB else "care" if free_gb < GOOD_FREE_GB else "ok"
    fix = "make room, or move old recordings to the backup"
    yield Finding("disk", verdict, f"{free_gb:.1f} GB free; a test takes 5 MB", fix)


def check_database(settings: Settings) -> Iterator[Finding]:
    """Check that the database opens, and that the chain of its audit trail is complete."""
    try:
        broken = audit.first_broken(stored(settings))
    except InputError:
        yield Finding("database", "ok", "not there yet; the first start makes it")
    except ApiError as error:
        yield Finding("database", "fails", str(error), "restore it from the backup (docs/install.md)")
    else:
        text = "opens; its audit trail is whole" if broken is None else f"the audit trail is broken at entry {broken}"
        fix = "compare with the backup: the database was changed outside the service"
        yield Finding("database", "ok" if broken is None else "fails", text, fix)


def check_rights(_settings: Settings) -> Iterator[Finding]:
    """Check that the rig's sender may run before everything else, from memory that stays."""
    for name, code, right, unit, line in RIGHTS:
        granted = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=30).returncode == 0
        fix = f"{unit} as in deploy/systemd/stimrig-rig.service, or `USER - {line}` in /etc/security/limits.d"
        yield Finding(name, "ok" if granted else "care", right if granted else f"not granted: {right}", fix)


def doctor(
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: STIMRIG_RIG_FILE")] = None,
    data: DataDir = None,
    socket: Annotated[Path | None, typer.Option(help="a running rig's socket, or STIMRIG_RIG_SOCKET")] = None,
    as_json: Json = False,
) -> None:
    """Check devices, permissions, disk, priority; say how to fix each. Sends nothing. Exit 1 if one fails."""
    findings = examine(Settings(**set_options(rig_file=rig, data_dir=data, rig_socket=socket)))
    worst = max((finding.verdict for finding in findings), key=VERDICTS.index)
    lines = []
    for each in findings:
        lines += [f"{each.verdict:6} {each.check:14} {each.says}"]
        lines += [f"{'':21} -> {each.fix}"] if each.verdict != "ok" and each.fix else []
    report({"verdict": worst, "findings": [asdict(each) for each in findings]}, as_json, *lines)
    if worst == "fails":
        raise typer.Exit(1)

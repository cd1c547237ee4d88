"""`stimrig doctor`: check what this machine needs for a rig, and say how to fix what is missing."""

from __future__ import annotations

import json
import os
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer

from stimrig.api.cli.options import Json, set_options
from stimrig.api.cli.terminal import say, say_json
from stimrig.api.settings import Settings

Verdict = Literal["ok", "care", "fails"]
LEAST_FREE_GB, GOOD_FREE_GB = 0.5, 5.0
SENDER_PRIORITY = 50
LATE_MS, SLOW_DISK_MS = 5.0, 200.0


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
    """Read the rig file with the rig's own reader, in a process of its own."""
    if settings.rig_file is None:
        yield Finding("rig file", "ok", "none given: the emulated rig will be used")
        return
    code = "import sys, pathlib; from stimrig.rig import config; config.load(pathlib.Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(settings.rig_file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode == 0:
        yield Finding("rig file", "ok", f"{settings.rig_file}: every key is valid")
    else:
        last = (done.stderr.strip().splitlines() or ["it cannot be read"])[-1].partition("Error: ")
        yield Finding("rig file", "fails", last[2] or last[0], "docs/rig-file.md lists every key")


def check_devices(settings: Settings) -> Iterator[Finding]:
    """Check that the stimulator's port and the load cell's bus are there, and that this user may use them."""
    if settings.rig_file is None or not settings.rig_file.is_file():
        return
    content = tomllib.loads(settings.rig_file.read_text("utf-8"))
    if port := (content.get("stimulator") or {}).get("port"):
        yield examine_port("stimulator", Path(port))
    if bus := (content.get("load_cell") or {}).get("bus"):
        yield examine_bus(bus)


def examine_port(device: str, port: Path) -> Finding:
    """Check a serial port."""
    if not port.exists():
        fix = "plug it in and switch it on; `ls -l /dev/serial/by-id /dev/stimrig` shows what is there"
        return Finding(device, "fails", f"{port} is not there", fix)
    if not stat.S_ISCHR(port.stat().st_mode):
        return Finding(device, "fails", f"{port} is no serial port", "give its name under /dev in the rig file")
    if not os.access(port, os.R_OK | os.W_OK):
        fix = "add this user to the port's group (dialout), or install deploy/udev/70-stimrig.rules; sign in again"
        return Finding(device, "fails", f"{port} may not be read and written by this user", fix)
    return Finding(device, "ok", f"{port} is there and may be used")


def examine_bus(bus: dict[str, Any]) -> Finding:
    """Check the load cell's CAN bus, as far as its kind allows without opening it."""
    kind, channel = str(bus.get("interface", "")), str(bus.get("channel", ""))
    if kind == "slcan":
        return examine_port("load cell", Path(channel.partition("@")[0]))
    verdict, text, fix = "care", f"a {kind} bus cannot be checked without opening it", ""
    if kind == "socketcan":
        link = Path("/sys/class/net") / channel
        if not link.exists():
            verdict, text = "fails", f"there is no interface {channel}"
            fix = f"plug the adapter in; systemctl start stimrig-can@{channel} brings it up"
        elif not int((link / "flags").read_text(), 16) & 1:
            verdict, text = "fails", f"{channel} is down"
            fix = f"ip link set {channel} up type can bitrate …, or systemctl start stimrig-can@{channel}"
        else:
            verdict, text = "ok", f"{channel} is up"
    elif kind == "socketcand":
        host, port = str(bus.get("host", "127.0.0.1")), int(bus.get("port", 29536))
        try:
            socket.create_connection((host, port), timeout=2).close()
            verdict, text = "ok", f"socketcand answers at {host}:{port}"
        except OSError as error:
            verdict, text = "fails", f"socketcand at {host}:{port}: {error.strerror or error}"
            fix = "start socketcand on that machine"
    return Finding("load cell", verdict, text, fix)


def check_rig(settings: Settings) -> Iterator[Finding]:
    """Check that the rig's process answers, and is not latched."""
    if settings.rig_socket is None:
        return
    try:
        with socket.socket(socket.AF_UNIX) as line:
            line.settimeout(3)
            line.connect(str(settings.rig_socket))
            line.sendall(b'{"kind": "status", "id": 1}\n')
            status = json.loads(line.makefile().readline())["body"]
    except (OSError, ValueError, KeyError) as error:
        fix = "systemctl status stimrig-rig; its journal says why"
        yield Finding("rig", "fails", f"{settings.rig_socket}: no answer ({error})", fix)
        return
    if status["state"] in ("latched", "uncertain", "disconnected"):
        fix = "check the participant and the rig, then re-arm it on the page"
        yield Finding("rig", "fails", f"{status['state']}: {status['reason']}", fix)
    else:
        yield Finding("rig", "ok", status["state"])


def check_data(settings: Settings) -> Iterator[Finding]:
    """Check the data folder: writable, closed to others, with room, on a disk that is fast enough."""
    folder = settings.data_dir.absolute()
    nearest = nearest_folder(folder)
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
    slowest_ms = max(synced_ms(nearest) for _ in range(5))
    text = f"slowest of five writes to the disk: {slowest_ms:.0f} ms"
    verdict = "care" if slowest_ms > SLOW_DISK_MS else "ok"
    yield Finding("disk speed", verdict, text, "use a local disk, not a network disk")


def nearest_folder(path: Path) -> Path:
    """Return the path, or the nearest folder above it that exists."""
    return next(place for place in (path, *path.parents) if place.exists())


def synced_ms(folder: Path) -> float:
    """Return the time to bring one second of a journal to the disk, ms."""
    with tempfile.TemporaryFile(dir=folder) as file:
        began = time.perf_counter()
        file.write(b"\0" * 65536)
        file.flush()
        os.fsync(file.fileno())
        return 1000 * (time.perf_counter() - began)


def check_database(settings: Settings) -> Iterator[Finding]:
    """Check that the database opens, and that the chain of its audit trail is complete."""
    if settings.database_url is None and not (settings.data_dir / "stimrig.db").exists():
        yield Finding("database", "ok", "not there yet; the first start makes it")
        return
    from stimrig.api.errors import ApiError
    from stimrig.api.store import Store, audit
    from stimrig.api.store.tables import AuditEntry

    try:
        with closing(Store(settings.database)) as store:
            entries = store.all(AuditEntry, order=AuditEntry.seq)
    except ApiError as error:
        yield Finding("database", "fails", str(error), "restore it from the backup (docs/install.md)")
        return
    if (broken := audit.first_broken(entries)) is None:
        yield Finding("database", "ok", f"opens; the chain of the audit trail's {len(entries)} entries is complete")
    else:
        fix = "compare with the backup: the database was changed outside the service"
        yield Finding("database", "fails", f"the audit trail is broken at entry {broken}", fix)


def check_wake_up(_settings: Settings) -> Iterator[Finding]:
    """Check that this machine wakes up in time."""
    late_ms = []
    for _ in range(200):
        began = time.perf_counter()
        time.sleep(0.002)
        late_ms.append(1000 * (time.perf_counter() - began) - 2)
    worst_ms = sorted(late_ms)[-3]
    fix = "end other programs on this machine; give the rig real-time priority"
    text = f"wakes up {worst_ms:.2f} ms late at the 99th percentile (a pulse is dropped at 3.75 ms)"
    yield Finding("wake-up", "ok" if worst_ms < LATE_MS else "care", text, fix)


RIGHTS = {
    "priority": (
        f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({SENDER_PRIORITY}))",
        ("real-time priority is granted", "no real-time priority for this user"), "LimitRTPRIO=60", "rtprio 60",
    ),
    "memory": (
        "import ctypes, sys; sys.exit(-ctypes.CDLL(None).mlockall(7))",
        ("the rig's memory may be kept from the disk", "this user may not lock memory: after a rest it may be read "
         "back from the disk, and a pulse is late"), "LimitMEMLOCK=infinity", "memlock unlimited",
    ),
}  # fmt: skip
"""By check: a program that needs the right, what to say with and without it, and the lines that grant it."""


def check_rights(_settings: Settings) -> Iterator[Finding]:
    """Check that the rig's sender may run before everything else, from memory that stays."""
    for name, (code, text, unit, line) in RIGHTS.items():
        allowed = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=30).returncode == 0
        fix = f"{unit} as in deploy/systemd/stimrig-rig.service, or `USER - {line}` in /etc/security/limits.d"
        yield Finding(name, "ok" if allowed else "care", text[not allowed], "" if allowed else fix)


def check_compiled(_settings: Settings) -> Iterator[Finding]:
    """Check that what numba compiles is kept, so that the first fit is not a slow one."""
    from stimrig import identify

    place = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(str(identify.__file__)).parent)
    writable = os.access(nearest_folder(place), os.W_OK | os.X_OK)
    text = f"{place} {'may' if writable else 'may not'} be written"
    fix = "set NUMBA_CACHE_DIR to a folder of this user; otherwise each start compiles again, for about ten seconds"
    yield Finding("compiled code", "ok" if writable else "care", text, "" if writable else fix)


def check_door(settings: Settings) -> Iterator[Finding]:
    """Check that the service is closed to the network unless TLS stands in front."""
    from stimrig.api.web.server import refuse_open_door

    try:
        refuse_open_door(settings)
    except OSError as error:
        yield Finding("address", "fails", str(error))
        return
    with socket.socket(socket.AF_INET6 if ":" in settings.host else socket.AF_INET) as line:
        line.settimeout(1)
        in_use = line.connect_ex((settings.host, settings.port)) == 0
    text = f"{settings.host}:{settings.port} {'is in use, by the service or another program' if in_use else 'is free'}"
    yield Finding("address", "ok", text)


MARKS = {"ok": "ok   ", "care": "care ", "fails": "FAILS"}


def doctor(
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: STIMRIG_RIG_FILE")] = None,
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    socket: Annotated[Path | None, typer.Option(help="a running rig's socket, or STIMRIG_RIG_SOCKET")] = None,
    as_json: Json = False,
) -> None:
    """Check devices, permissions, disk, priority; say how to fix each. Sends nothing. Exit 1 if one fails."""
    findings = examine(Settings(**set_options(rig_file=rig, data_dir=data, rig_socket=socket)))
    worst = max((finding.verdict for finding in findings), key=get_args(Verdict).index, default="ok")
    if as_json:
        say_json({"verdict": worst, "findings": [asdict(finding) for finding in findings]})
    else:
        for finding in findings:
            say(f"{MARKS[finding.verdict]}  {finding.check:14} {finding.says}")
            if finding.verdict != "ok" and finding.fix:
                say(f"{'':23}-> {finding.fix}")
    if worst == "fails":
        raise typer.Exit(1)

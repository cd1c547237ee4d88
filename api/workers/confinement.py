"""A worker shuts itself in before it reads what others made: no network, no other program, no file but what it needs.

Files are read and computed on here that anybody with the right to upload may have made. If one of them takes the
process over, there must be nothing to take: no secret in the environment (`api.workers.pool`), no file of the service
but recordings (Landlock), no connection (seccomp), and bounds on memory, processor time, open files and their size.

Where the system lacks one of these, the worker runs without it and says so: `stimrig doctor` and the log tell.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import platform
import resource
import signal
import struct
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

PACKAGE = Path(__file__).absolute().parents[2]
"""`stimrig`; in a checkout its packages are links to the folders beside it."""
MEMORY_BYTES = 2 * 2**30
"""Three times what the largest record takes."""
FILE_BYTES = 512 * 2**20
OPEN_FILES = 256
SYSTEM = (
    "/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/ssl/openssl.cnf", "/proc/self", "/proc/cpuinfo",
    "/proc/meminfo", "/sys/devices/system", "/dev/urandom",
)  # fmt: skip
LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None
DEATH_SIGNAL, NO_NEW_PRIVILEGES, SECCOMP, FILTER = 1, 38, 22, 2
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
READ_FILE, READ_FOLDER, WRITE_FILE, TRUNCATE = 1 << 2, 1 << 3, 1 << 1, 1 << 14
CHANGE_FOLDER = 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8
"""Remove and make files and folders."""
FORBIDDEN = {
    "x86_64": (0xC000003E, 302, {
        "socket": 41, "socketpair": 53, "ptrace": 101, "process_vm_readv": 310, "process_vm_writev": 311,
        "io_uring_setup": 425, "pidfd_getfd": 438,
        "setpriority": 141, "ioprio_set": 251, "sched_setparam": 142, "sched_setscheduler": 144,
        "sched_setaffinity": 203, "sched_setattr": 314,
        "chmod": 90, "fchmod": 91, "fchmodat": 268, "fchmodat2": 452, "chown": 92, "fchown": 93, "lchown": 94,
        "fchownat": 260, "setxattr": 188, "lsetxattr": 189, "fsetxattr": 190, "removexattr": 197, "lremovexattr": 198,
        "fremovexattr": 199, "setxattrat": 463, "removexattrat": 466,
    }),
    "aarch64": (0xC00000B7, 261, {
        "socket": 198, "socketpair": 199, "ptrace": 117, "process_vm_readv": 270, "process_vm_writev": 271,
        "io_uring_setup": 425, "pidfd_getfd": 438,
        "setpriority": 140, "ioprio_set": 30, "sched_setparam": 118, "sched_setscheduler": 119,
        "sched_setaffinity": 122, "sched_setattr": 274,
        "fchmod": 52, "fchmodat": 53, "fchmodat2": 452, "fchown": 55, "fchownat": 54, "setxattr": 5, "lsetxattr": 6,
        "fsetxattr": 7, "removexattr": 14, "lremovexattr": 15, "fremovexattr": 16, "setxattrat": 463,
        "removexattrat": 466,
    }),
}  # fmt: skip
"""By processor: its number for the filter, the number of prlimit64, and system calls that reach a network, another
process, or the rights on another's files, which Landlock leaves alone."""


def confine(
    reads: Iterable[Path] = (), writes: Iterable[Path] = (), memory_bytes: int = MEMORY_BYTES
) -> dict[str, str]:
    """Shut this process in, for good; what could not be shut, and why.

    `reads`, `writes`: folders that stay open, beside those of Python and of the system's libraries; `memory_bytes`:
    addresses that it may take, those of its libraries included.
    """
    for kind, most in (
        (resource.RLIMIT_AS, memory_bytes), (resource.RLIMIT_FSIZE, FILE_BYTES),
        (resource.RLIMIT_NOFILE, OPEN_FILES), (resource.RLIMIT_CORE, 0),
    ):  # fmt: skip
        hard = resource.getrlimit(kind)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (least, least))
    left_open = {}
    for what, shut in (("files", lambda: _shut_files(reads, writes)), ("network", _shut_network)):
        try:
            shut()
        except OSError as error:
            left_open[what] = error.strerror or str(error)
    return left_open


def end_with_parent() -> None:
    """From now on this process is killed when the one that started it ends, in the middle of a computation, too."""
    with contextlib.suppress(OSError):
        _ask("prctl", DEATH_SIGNAL, signal.SIGKILL)


def limit_time(seconds: float) -> None:
    """From now on so much processor time; then the process is ended (SIGXCPU)."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    soft = int(used.ru_utime + used.ru_stime + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def taken() -> tuple[int, int] | None:
    """Bytes of addresses, and of memory, that this process has taken; None where the system does not tell."""
    try:
        addresses, memory = Path("/proc/self/statm").read_text("ascii").split()[:2]
    except OSError:
        return None
    return int(addresses) * resource.getpagesize(), int(memory) * resource.getpagesize()


def _shut_network() -> None:
    """Refuse every system call that makes a socket, reaches another process, or changes who may open a file.

    Raises OSError: not on this system.
    """
    known = FORBIDDEN.get(platform.machine())
    if known is None:
        raise OSError(0, f"no filter of system calls for {sys.platform} on {platform.machine()}")
    load, equal, at_least, answer = 0x20, 0x15, 0x35, 0x06
    allow, refuse = 0x7FFF0000, 0x00050000 | 1
    processor, prlimit, numbers = known[0], known[1], sorted(known[2].values())
    last = 8 + len(numbers)  # the line that refuses; jumps count from the line behind them
    program = [(load, 0, 0, 4), (equal, 0, last - 2, processor), (load, 0, 0, 0), (at_least, last - 4, 0, 0x40000000)]
    program += [(equal, last - 1 - line, 0, number) for line, number in enumerate(numbers, start=4)]
    program += [(equal, 0, 2, prlimit), (load, 0, 0, 16), (equal, 0, 1, 0)]  # bounds of this process (0) alone
    program += [(answer, 0, 0, allow), (answer, 0, 0, refuse)]
    packed = b"".join(struct.pack("HBBI", *line) for line in program)
    code = ctypes.create_string_buffer(packed, len(packed))
    _ask("prctl", NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    _ask("prctl", SECCOMP, FILTER, struct.pack("HP", len(program), ctypes.addressof(code)), 0, 0)


def _shut_files(reads: Iterable[Path], writes: Iterable[Path]) -> None:
    """Leave only these folders open, and what Python needs. Raises OSError: not on this system."""
    version = _ask("syscall", CREATE_RULESET, 0, 0, 1)
    handled = (1 << 13) - 1
    for least, right in ((2, 1 << 13), (3, TRUNCATE), (5, 1 << 15)):
        handled |= right if version >= least else 0
    connections, others = 3 if version >= 4 else 0, 3 if version >= 6 else 0  # TCP; sockets and signals of others
    attributes = struct.pack("QQQ", handled, connections, others)
    rules = _ask("syscall", CREATE_RULESET, attributes, 24 if others else 16 if connections else 8, 0)
    try:
        read, write = READ_FILE | READ_FOLDER, READ_FILE | READ_FOLDER | WRITE_FILE | TRUNCATE | CHANGE_FOLDER
        for path in (*map(Path, SYSTEM), *code_folders(), *reads):
            _open(rules, path, read)
        for path in (*cache_folders(), *writes):
            _open(rules, path, write & handled)
        _open(rules, Path(os.devnull), (READ_FILE | WRITE_FILE | TRUNCATE) & handled)
        for root in code_roots():
            _open(rules, root, READ_FOLDER)
        _ask("prctl", NO_NEW_PRIVILEGES, 1, 0, 0, 0)
        _ask("syscall", RESTRICT_SELF, rules, 0)
    finally:
        os.close(rules)


def _open(rules: int, path: Path, rights: int) -> None:
    with contextlib.suppress(FileNotFoundError):
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            if not path.is_dir():
                rights &= READ_FILE | WRITE_FILE | TRUNCATE
            _ask("syscall", ADD_RULE, rules, 1, struct.pack("=Qi", rights, place), 0)
        finally:
            os.close(place)


def code_roots() -> list[Path]:
    """Folders from which this software is imported: a data folder may lie in one, so only packages in it are open."""
    return [PACKAGE.parent.resolve()]  # as the folders of `sys.path`, from which it is taken


def code_folders() -> list[Path]:
    """Where Python, its packages and ours lie."""
    ours = [PACKAGE, *((PACKAGE / name).resolve() for name in ("api", "identify", "rig"))]
    theirs = {Path(entry).resolve() for entry in (sys.prefix, sys.base_prefix, *sys.path) if entry}
    return [*ours, *(theirs - {*code_roots(), Path.cwd()})]


def cache_folders() -> list[Path]:
    """Where numba keeps what it compiled."""
    if place := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(place)]
    found = [module.parent / "__pycache__" for module in (PACKAGE / "identify").resolve().rglob("__init__.py")]
    for folder in found:
        with contextlib.suppress(OSError):
            folder.mkdir(exist_ok=True)
    return found


def _ask(function: str, *arguments: int | bytes) -> int:
    """A call of the C library, bytes given by their address; its error raised."""
    if LIBC is None:
        raise OSError(0, f"not on {sys.platform}")
    passed = [ctypes.c_char_p(each) if isinstance(each, bytes) else ctypes.c_long(each) for each in arguments]
    found = getattr(LIBC, function)(*passed)
    if found < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return found


def main(arguments: Sequence[str]) -> None:
    """`python -m stimrig.api.workers.confinement`: try it, and say what stays open as one JSON object."""
    print(json.dumps(confine(map(Path, arguments))))


if __name__ == "__main__":
    main(sys.argv[1:])

"""`python -m tests`: every test, in lanes side by side; then, with nothing beside them, those on the wire.

A test on the wire keeps time with the emulator, so nothing may stand in its way. The others need no time of their
own, so they share the processors.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time

SIDE_BY_SIDE = {
    "api": ("-m", "not wire and not browser", "tests/api"),
    "pages": ("-m", "not wire and browser", "tests/api"),
    "rest": ("-m", "not wire", "tests", "--ignore=tests/api"),
}
ALONE = {"wire": ("-m", "wire", "tests")}


TELLING = ("FAILED ", "ERROR ", "E  ")
"""How the lines begin that say what failed: printed once more at the end, where people look first."""


def run(lanes: dict[str, tuple[str, ...]], failures: list[str]) -> dict[str, int]:
    """Start all lanes, print what they print as it comes, add what failed, return their exit codes."""
    codes = dict.fromkeys(lanes, 1)  # until it is known to be another

    def follow(name: str, arguments: tuple[str, ...]) -> None:
        command = [sys.executable, "-m", "pytest", "--durations=5", *arguments]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                print(f"[{name}] {line}", end="", flush=True)
                if line.startswith(TELLING):
                    failures.append(f"[{name}] {line.rstrip():.300}")
        codes[name] = process.returncode

    threads = [threading.Thread(target=follow, args=lane) for lane in lanes.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return codes


def main() -> int:
    """Exit code 0 only if each lane ran tests and all of them passed."""
    began_s = time.monotonic()
    failures: list[str] = []
    codes = run(SIDE_BY_SIDE, failures) | run(ALONE, failures)
    if failures:
        print("\n".join(failures[-40:]))
    print(f"{time.monotonic() - began_s:.0f} s; exit codes {codes}")
    return 0 if set(codes.values()) == {0} else 1


if __name__ == "__main__":
    sys.exit(main())

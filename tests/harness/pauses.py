"""A disturber: a command runs while its processes are stopped and continued at random, as on a machine that pauses.

`python -m tests.harness.pauses --seed 1 -- python -m pytest tests/wire` (`make pauses`): for 5 % of the time, for 0.05
to 1 s each, either every process of the command stands still, as when a machine is paused, or one of them. The seed
tells when, for how long and which; a pattern of times can so be repeated, though never what the processes do then.

Whatever ends the disturber, nothing stays stopped: a guardian, a process of its own, is told before anything is
stopped. It continues everything when the disturber's end of its pipe closes, and after `LONGEST_S` anyhow.

Paced time (`tests/harness/paced_time`) waits for a process that is stopped here, as it waits for one that is given no
processor: the disturber's folder holds its number. It doesn't wait for one that a test stops.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SHARE = 0.05
SHORTEST_S, LONGEST_S = 0.05, 1.0
PATIENCE_S = 5.0
"""A guardian that hears nothing for so long while processes are stopped continues them."""
VARIABLE = "STIMRIG_TESTS_PAUSED"
"""The environment variable with the folder that holds a file for each process that is stopped here."""
BECOME_SUBREAPER = 36
"""Of prctl: processes whose parent has ended become children of this one, so that they are found."""


@dataclass(frozen=True)
class Pause:
    """When, s after the pause before; for how long; and which: of all processes in a row, or none: all at once."""

    after_s: float
    duration_s: float
    which: float | None

    def of(self, pids: list[int]) -> list[int]:
        """Those of the processes that stand still."""
        return pids if self.which is None else [pids[int(self.which * len(pids))]]


def pattern(
    seed: int, share: float = SHARE, shortest_s: float = SHORTEST_S, longest_s: float = LONGEST_S
) -> Iterator[Pause]:
    """The pauses of a seed, without end.

    Parameters
    ----------
    seed : the same seed, the same pauses.
    share : of the time, on average.
    shortest_s, longest_s : of a pause.
    """
    draw = random.Random(seed)
    gap_s = (shortest_s + longest_s) / 2 * (1 - share) / share
    while True:
        after_s, duration_s = draw.expovariate(1 / gap_s), draw.uniform(shortest_s, longest_s)
        all_at_once, which = draw.random() < 0.5, draw.random()
        yield Pause(after_s, duration_s, None if all_at_once else which)


def stat(pid: int) -> tuple[str, int] | None:
    """A process's state and its parent; none: there is no such process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    except OSError:
        return None
    return fields[0], int(fields[1])


def below(root: int) -> list[int]:
    """Every process below one, by its number."""
    children: dict[int, list[int]] = {}
    for path in Path("/proc").iterdir():
        if path.name.isdigit() and (found := stat(int(path.name))):
            children.setdefault(found[1], []).append(int(path.name))
    tree = [root]
    for pid in tree:
        tree.extend(children.get(pid, []))
    return sorted(tree[1:])


def signal_to(pids: list[int], number: int) -> None:
    """To those that are there."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


class Guardian:
    """Continues what is stopped, once nobody else does.

    `folder` holds a file for each process that is stopped.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._stopped = folder, list[int]()
        read, self._write = os.pipe()
        command = [sys.executable, "-m", "tests.harness.pauses", "--guard", str(read), str(folder)]
        self.process = subprocess.Popen(
            command, cwd=Path(__file__).parents[2], pass_fds=(read,), stdout=subprocess.PIPE, start_new_session=True
        )
        os.close(read)
        assert self.process.stdout is not None
        if not self.process.stdout.readline():
            raise RuntimeError("the guardian of paused processes did not begin")

    def stop(self, pids: list[int]) -> None:
        """Stop processes, unless a test has."""
        for pid in pids:
            found = stat(pid)
            if found is not None and found[0] not in "TtZX":
                os.write(self._write, b".")  # raises if there is no guardian
                (self.folder / str(pid)).touch()
                self._stopped.append(pid)
                signal_to([pid], signal.SIGSTOP)

    def resume(self) -> None:
        """Continue all of them."""
        signal_to(self._stopped, signal.SIGCONT)
        self._stopped.clear()
        resume(self.folder)

    def close(self) -> None:
        """Continue everything, and end."""
        self.resume()
        os.close(self._write)
        self.process.wait()


def resume(folder: Path) -> None:
    """Continue every process that has a file in this folder."""
    files = [path for path in folder.iterdir() if path.name.isdigit()] if folder.exists() else []
    signal_to([int(path.name) for path in files], signal.SIGCONT)
    for path in files:
        path.unlink(missing_ok=True)


def guard(pipe: int, folder: Path) -> None:
    """What the guardian does until the disturber ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    print("ready", flush=True)
    while True:
        ready, _, _ = select.select([pipe], [], [], PATIENCE_S)
        if ready and not os.read(pipe, 4096):
            break
        if not ready:
            resume(folder)
    resume(folder)
    shutil.rmtree(folder, ignore_errors=True)


class Disturbed:
    """A command under the disturber."""

    def __init__(self, command: list[str], seed: int, share: float = SHARE) -> None:
        self.command, self.pattern = command, pattern(seed, share)
        self.count, self.paused_s = 0, 0.0
        self._ended = threading.Event()
        self._code = 1

    def run(self) -> int:
        """Run it to its end; its exit code."""
        ctypes.CDLL(None, use_errno=True).prctl(BECOME_SUBREAPER, 1, 0, 0, 0)
        folder = Path(tempfile.mkdtemp(prefix="paused-"))
        guardian = Guardian(folder)
        process = subprocess.Popen(self.command, env={**os.environ, VARIABLE: str(folder)})
        threading.Thread(target=self._reap, args=(process.pid,), daemon=True).start()
        try:
            for pause in self.pattern:
                if self._ended.wait(pause.after_s) or not self._pause(pause, guardian):
                    break
        except KeyboardInterrupt:
            guardian.resume()
            self._ended.wait()  # the terminal has told it, too: it ends as it does
        finally:
            guardian.resume()
            if not self._ended.is_set():
                process.terminate()
                self._ended.wait()
            guardian.close()
        return self._code

    def _pause(self, pause: Pause, guardian: Guardian) -> bool:
        """One pause; whether the command goes on after it."""
        pids = [pid for pid in below(os.getpid()) if pid != guardian.process.pid]
        if not pids:
            return False
        began_s = time.monotonic()
        try:
            guardian.stop(pause.of(pids))
            ended = self._ended.wait(pause.duration_s)
        finally:
            guardian.resume()
        self.count += 1
        self.paused_s += time.monotonic() - began_s
        return not ended

    def _reap(self, command: int) -> None:
        """Take the end of every process below this one, as init would."""
        ended = 0
        while ended != command:
            ended, status = os.waitpid(-1, 0)
            self._code = os.waitstatus_to_exitcode(status)
        self._ended.set()


def main(arguments: list[str]) -> int:
    """Run a command under the disturber; its exit code."""
    if arguments[:1] == ["--guard"]:
        guard(int(arguments[1]), Path(arguments[2]))
        return 0
    parser = argparse.ArgumentParser(prog="python -m tests.harness.pauses", description=__doc__)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--share", type=float, default=SHARE, help="of the time")
    parser.add_argument("command", nargs="+")
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"pauses: SEED={seed} repeats these times", flush=True)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(1))
    disturbed = Disturbed(options.command, seed, options.share)
    code = 1
    try:
        code = disturbed.run()
    finally:
        told = "green" if code == 0 else f"not green (exit code {code})"
        print(f"pauses: {disturbed.count}, {disturbed.paused_s:.1f} s in all, SEED={seed}; the suite was {told}")
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

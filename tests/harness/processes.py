"""The emulator and the rig as processes of their own, and a plain client of the rig's socket: for tests and benches."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).resolve().parents[2]
READY_TIMEOUT_S = 120.0
ANSWER_TIMEOUT_S = 60.0
"""Both are reached only where something hangs: a busy machine may take long to start a process."""
CLINIC_WATCH: dict[str, float] = {}
"""The watch of a rig file that says nothing of it: for benches that measure how soon silence stops a test."""


class Process:
    """A child that prints one JSON line on standard output once it is ready."""

    def __init__(self, *arguments: str, log: Path) -> None:
        self.log = log
        self._stderr = log.open("ab")
        self.popen = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,  # a key in the terminal of whoever tests is not meant for this rig
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            text=True,
        )
        self.ready = self._first_line(arguments)

    def _first_line(self, arguments: tuple[str, ...]) -> dict[str, Any]:
        lines: queue.Queue[str] = queue.Queue()
        stdout = self.popen.stdout
        assert stdout is not None
        threading.Thread(target=lambda: lines.put(stdout.readline()), daemon=True).start()
        try:
            line = lines.get(timeout=READY_TIMEOUT_S)
        except queue.Empty:
            line = ""
        if not line.strip():
            self.stop(signal.SIGKILL)
            raise RuntimeError(f"{' '.join(arguments)} was not ready; its log: {self.log.read_text()[-3000:]}")
        return json.loads(line)

    def stop(self, number: int = signal.SIGTERM, timeout_s: float = ANSWER_TIMEOUT_S) -> int:
        """End it and return its exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
            try:
                self.popen.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait()
        if self.popen.stdout is not None:
            self.popen.stdout.close()
        self._stderr.close()
        return self.popen.returncode


class RigClient:
    """Talks to the rig's socket: requests with their replies, and the events as they come."""

    def __init__(self, path: str | Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.connect(str(path))
        self._file = self._socket.makefile("rb")
        self._id = 0
        self._replies: dict[int, queue.Queue[dict[str, Any]]] = {}
        self.events: queue.Queue[dict[str, Any]] = queue.Queue()
        self.closed = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in self._file:
                message = json.loads(line)
                if "event" in message:
                    self.events.put(message)
                else:
                    self._replies[message["id"]].put(message)
        self.closed.set()

    def ask(self, kind: str, timeout_s: float = ANSWER_TIMEOUT_S, **fields: Any) -> dict[str, Any]:
        """Send a request and return the whole reply."""
        self._id += 1
        self._replies[self._id] = queue.Queue()
        self.send_raw(json.dumps({"kind": kind, "id": self._id, **fields}))
        return self._replies[self._id].get(timeout=timeout_s)

    def start(self, plan: dict[str, Any], timeout_s: float = ANSWER_TIMEOUT_S) -> dict[str, Any]:
        """Ask for a test, once the rest between two tests is over; the whole reply."""
        end = time.monotonic() + 30
        while True:
            reply = self.ask("start", timeout_s, plan=plan)
            if reply["ok"] or "rest_between_tests_s" not in reply["problem"]["detail"] or time.monotonic() > end:
                return reply
            time.sleep(0.05)

    def rearm(self, by: str) -> dict[str, Any]:
        """Look at the rig, then re-arm it; the whole reply. Who is told of another stop or lost device looks again."""
        for _ in range(10):
            reply = self.ask("rearm", by=by, latch=self.status()["latch"])
            if reply["ok"] or reply["problem"]["code"] != "latch-changed":
                break
        return reply

    def send_raw(self, line: str) -> None:
        """Send a line as it is."""
        self._socket.sendall(line.encode() + b"\n")

    def status(self) -> dict[str, Any]:
        """The rig's status."""
        return self.ask("status")["body"]

    def wait_state(self, *states: str, timeout_s: float = ANSWER_TIMEOUT_S) -> dict[str, Any]:
        """Poll until the rig is in one of the states."""
        end = time.monotonic() + timeout_s
        while (status := self.status())["state"] not in states:
            if time.monotonic() > end:
                raise TimeoutError(f"still {status['state']} ({status['reason']}), wanted {states}")
            time.sleep(0.02)
        return status

    def wait_finished(self, test_id: str, timeout_s: float = 90.0) -> dict[str, Any]:
        """Take events until the test's finished event; needs `subscribe` first."""
        end = time.monotonic() + timeout_s
        while True:
            event = self.events.get(timeout=max(0.01, end - time.monotonic()))
            if event["event"] == "finished" and event["test_id"] == test_id:
                return event

    def close(self) -> None:
        """Let the rig go."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class Bench:
    """An emulator and, on demand, a rig on it, in a folder of their own.

    A socket's path must be short, so it lies in a temporary folder.
    """

    def __init__(self, folder: Path, *emulator_options: str, speed: float = 1.0) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.speed = speed
        self._socket_folder = tempfile.TemporaryDirectory(prefix="rig-")
        self.socket = Path(self._socket_folder.name) / "rig.sock"
        self.data = folder / "data"
        log = folder / "emulator.log"
        self.emulator = Process("stimrig.hardware_sim", "--speed", f"{speed:g}", *emulator_options, log=log)
        with contextlib.suppress(OSError):  # hardware does not wait for a processor, so neither should its stand-in
            os.sched_setscheduler(self.emulator.popen.pid, os.SCHED_RR, os.sched_param(10))
        self.rig: Process | None = None
        self._clients: list[RigClient] = []

    def start_rig(self, *options: str, module: str = "stimrig.rig", watch: dict[str, float] | None = None) -> RigClient:
        """Start the rig and connect to it.

        `module` is what runs it, for benches that break its host; `watch` takes the place of an emulated rig's, which
        waits half a second, so that a busy machine does not end a test of something else than time.
        """
        ready = self.emulator.ready if watch is None else {**self.emulator.ready, "watch": watch}
        source = ("--emulator-json", json.dumps(ready), "--clock-speed", f"{self.speed:g}")
        places = ("--data", str(self.data), "--socket", str(self.socket))
        self.rig = Process(module, *source, *options, *places, log=self.folder / "rig.log")
        return self.client()

    def client(self) -> RigClient:
        """Another connection to the rig."""
        client = RigClient(self.socket)
        self._clients.append(client)
        return client

    def fault(self, **command: Any) -> dict[str, Any]:
        """Send one command to the emulator's control line and return its answer."""
        return control(self.emulator.ready["control"], command)

    def state(self) -> dict[str, Any]:
        """What the emulator says of itself."""
        return self.fault(cmd="state")

    def felt(self) -> list[dict[str, Any]]:
        """Every pulse that the emulated electrodes felt."""
        return self.fault(cmd="pulses", since=0)["pulses"]

    def close(self) -> None:
        """End both processes."""
        for client in self._clients:
            client.close()
        if self.rig is not None:
            self.rig.stop()
        self.emulator.stop()
        self._socket_folder.cleanup()


def control(address: Any, command: dict[str, Any]) -> dict[str, Any]:
    """One JSON line to the emulator's control socket, one back."""
    if isinstance(address, str):
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.connect(address)
    else:
        connection = socket.create_connection((address["host"], address["port"]))
    with connection, connection.makefile("rwb") as file:
        connection.settimeout(ANSWER_TIMEOUT_S)
        file.write(json.dumps(command).encode() + b"\n")
        file.flush()
        return json.loads(file.readline())


def short_plan(test_id: str, **fields: Any) -> dict[str, Any]:
    """A small test of 4 s: rest, PRBS, ramp, rest."""
    segments = [
        {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}},
        {"name": "prbs", "sequence": "prbs", "settings": {"bits": 5, "clock_pulses": 1}},
        {"name": "ramp", "sequence": "ramp", "settings": {"up_s": 1.0, "down_s": 1.0}},
        {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}},
    ]
    return default_plan(test_id, **{"segments": segments, **fields})


def default_plan(test_id: str, **fields: Any) -> dict[str, Any]:
    """The default pre-session test."""
    profile = {"current_ma": 20.0, "max_pulse_width_us": 300.0, "max_torque_nm": 30.0}
    return {"test_id": test_id, "participant": "P01", "profile": profile, **fields}


def alive(pid: int) -> bool:
    """Tell whether a process runs; one that has ended and is not waited for does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def below(root: int) -> list[int]:
    """List the ids of all processes below one."""
    return [process.pid for process in psutil.Process(root).children(recursive=True)]


def kill_hard(process: Process) -> None:
    """SIGKILL, as the kernel's out-of-memory killer would."""
    os.kill(process.popen.pid, signal.SIGKILL)
    process.popen.wait()


def later(bench: Bench) -> dict[str, Any]:
    """What the emulator says half a second of its own time later."""
    began_s = bench.state()["time_s"]
    end = time.monotonic() + 60
    while (state := bench.state())["time_s"] < began_s + 0.5:
        assert time.monotonic() < end
        time.sleep(0.02)
    return state


def made_ready(bench: Bench, client: RigClient) -> tuple[Bench, RigClient]:
    """A pair without faults, re-armed, whose events are read."""
    for name in bench.fault(cmd="faults")["active"]:
        bench.fault(cmd="fault", name=name, on=False)
    if client.status()["state"] != "ready":
        client.ask("stop", reason="the test before left it so", by="test")
        client.wait_state("latched", "disconnected")
        assert client.rearm("test")["ok"]
    while not client.events.empty():
        client.events.get_nowait()
    return bench, client

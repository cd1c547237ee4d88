"""One emulated rig that is broken and repaired again and again."""

from __future__ import annotations

import contextlib
import os
import queue
import random
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from tests.harness.campaign.cases import CASES, WINDOW_S, Case, angle_of, movement_of, plan_of
from tests.harness.campaign.judge import Verdict, judge_file, judge_intervals, judge_outcome, judge_times
from tests.harness.processes import CLINIC_WATCH, Bench, RigClient, busy_process, control, default_plan, kill_hard

DISK_MB = 96
MODULE = "tests.harness.campaign.host"


class StoppedBefore(RuntimeError):
    """The rig stopped by itself before anything was injected."""


class Worker:
    """An emulator, a rig on a small disk of its own, and what happened to them."""

    def __init__(self, number: int, speed: float) -> None:
        self.number, self.speed = number, speed
        self._folder = tempfile.TemporaryDirectory(prefix="rig-faults-")
        self.root = Path(self._folder.name)
        self.disk = self.root / "disk"
        self.disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(self.disk)]
        self.mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
        self.stopped_before: list[str] = []
        self._made = 0
        self._count = 0
        self.bench: Bench | None = None
        self.client: RigClient | None = None

    def close(self) -> None:
        """End everything and give the disk back."""
        self._drop()
        if self.mounted:
            subprocess.run(["umount", "-l", str(self.disk)], check=False)
        self._folder.cleanup()

    def inject(self, fault: str, phase: str, seed: int) -> Verdict:
        """Play a test, break it in that phase, mend it, and judge."""
        verdict = Verdict(fault, phase, seed)
        try:
            rng = random.Random(f"{fault}{phase}{seed}")
            try:
                self._inject(CASES[fault], verdict, rng)
            except StoppedBefore as stopped:  # once more: a busy machine is no injection
                self.stopped_before.append(str(stopped))
                self._drop()
                verdict = Verdict(fault, phase, seed)
                self._inject(CASES[fault], verdict, rng)
        except Exception as error:  # the campaign's own failing: told, counted apart, and made again by --resume
            verdict.failed = f"{type(error).__name__}: {error}"
            with contextlib.suppress(Exception):
                self._drop()
        return verdict

    def _inject(self, case: Case, verdict: Verdict, rng: random.Random) -> None:
        client = self._ready()
        self._count += 1
        test_id = f"{case.name}.{verdict.phase}.{verdict.seed}.{self._count}"
        segments = plan_of(verdict.phase, case.hidden_s, self.speed)
        plan = default_plan(test_id, segments=segments, **angle_of(case, self.speed))
        assert self.bench is not None
        moved = self.bench.fault(**movement_of(case))
        assert moved["ok"], moved
        before = self._felt_count()
        while not client.events.empty():
            client.events.get_nowait()
        accepted = verdict.phase != "arming"
        if verdict.phase == "arming":
            asked: queue.Queue[dict[str, Any]] = queue.Queue()

            def ask() -> None:
                with contextlib.suppress(queue.Empty, OSError):  # nobody answers: killed before it could
                    asked.put(self._start(client, plan))

            threading.Thread(target=ask, daemon=True).start()
            time.sleep(rng.uniform(0.0, 0.15))
            injected_s, undo = self._break(case)
            with contextlib.suppress(queue.Empty):
                reply = asked.get(timeout=1.0 if case.name == "host_killed" else 20.0)
                if not reply["ok"]:
                    self._refused(case, verdict, reply, undo)
                    return
                accepted = True
        else:
            reply = self._start(client, plan)
            assert reply["ok"], reply
            self._wait_phase(client, verdict.phase, rng)
            injected_s, undo = self._break(case)
        event = self._ended(case, client, test_id)
        verdict.outcome, verdict.reason = event["outcome"], event["reason"]
        stop = event["summary"].get("stop")
        if stop is not None and event["outcome"] != "completed":
            verdict.confirmed, verdict.evidence = stop["confirmed"], stop["detail"]
        felt = self._delivered(before)
        self._repair(case, verdict, undo)
        if self.bench is not None:
            felt = self._delivered(before)  # one that came after the end that was told would be seen here
        verdict.felt = len(felt)
        if event["recording_path"] is None:
            event = self._sealed_later(test_id) or event
        if event["recording_path"] is None and not accepted and not felt:
            return  # it died before it had said that there is a test: no pulse, and no file to open
        content = judge_file(verdict, event["recording_path"])
        judge_times(verdict, [p["monotonic_s"] for p in felt], injected_s)
        judge_intervals(verdict, [p["time_s"] for p in felt])
        judge_outcome(verdict)
        ended = verdict.phase == "sealing"
        if case.name == "host_killed" and not ended and content is not None and len(content["written_s"]) and felt:
            zero_s = felt[0]["monotonic_s"] - content["written_s"][0] / self.speed
            verdict.tail_ms = 1e3 * (injected_s - zero_s - content["host_s"][-1] / self.speed)
            if verdict.tail_ms > 50:
                verdict.wrong.append(
                    f"the last {verdict.tail_ms:.0f} ms of torque before the death are not in the file"
                )
        lost = event["summary"].get("lost_samples", 0)
        if lost and not case.loses_samples and case.must == "go on":
            verdict.wrong.append(f"{lost} samples lost")

    def _start(self, client: RigClient, plan: dict[str, Any]) -> dict[str, Any]:
        return client.start(plan, timeout_s=20)

    def _refused(self, case: Case, verdict: Verdict, reply: dict[str, Any], undo: Any) -> None:
        verdict.outcome, verdict.reason = "refused", reply["problem"]["detail"]
        self._repair(case, verdict, undo)

    def _wait_phase(self, client: RigClient, phase: str, rng: random.Random) -> None:
        """Until the segment has begun and a random part of it has passed."""
        end_s = time.monotonic() + 15
        if phase == "sealing":
            length_s = 1.1 / self.speed
            while (status := client.status())["state"] in ("arming", "running", "stopping", "latched"):
                if status["state"] in ("stopping", "latched"):
                    raise StoppedBefore(f"{status['state']} {status['reason']}")
                if status["elapsed_s"] / self.speed > length_s - 0.01:
                    break
                time.sleep(0.004)
            time.sleep(rng.uniform(0.0, 0.3))  # the device's stop, then the sealing itself
            return
        seen_stimulation = phase != "rest"
        while True:
            status = client.status()
            seen_stimulation = seen_stimulation or status["segment"] == "steps"
            if status["segment"] == phase and seen_stimulation:
                break
            if time.monotonic() > end_s or status["state"] in ("latched", "ready"):
                raise StoppedBefore(f"phase {phase} never came: {status['state']} {status['reason']}")
            time.sleep(0.004)
        time.sleep(rng.uniform(0.0, 0.9 * WINDOW_S) / self.speed)

    def _break(self, case: Case) -> tuple[float, Any]:
        bench = self.bench
        assert bench is not None
        if case.of == "emulator":
            command = case.command(self.speed)
            answer = bench.fault(**command)
            assert answer["ok"], answer
            return answer["monotonic_s"], lambda: bench.fault(cmd="fault", name=command["name"], on=False)
        return getattr(self, f"_{case.name}")()

    def _disk_full(self) -> tuple[float, Any]:
        assert self.mounted, "a full disk needs root, for a small tmpfs"
        for room_kb in (4, 8, 16, 32, 64):  # at once, however slow the machine is; the journal grows meanwhile
            with contextlib.suppress(subprocess.CalledProcessError):
                self._resize(f"{self._used_kb() + room_kb}k")
                break
        end_s = time.monotonic() + 0.5
        while os.statvfs(self.disk).f_bfree > 0 and time.monotonic() < end_s:  # now it is full, but for a last page
            time.sleep(0.001)
        return time.monotonic(), lambda: self._resize(f"{DISK_MB}m")

    def _used_kb(self) -> int:
        found = os.statvfs(self.disk)
        return (found.f_blocks - found.f_bfree) * found.f_frsize // 1024

    def _resize(self, size: str) -> None:
        command = ["mount", "-o", f"remount,size={size}", str(self.disk)]
        subprocess.run(command, check=True, capture_output=True)

    def _disk_slow(self) -> tuple[float, Any]:
        rig = self._rig()
        rig.send_signal(signal.SIGUSR1)
        injected_s = time.monotonic()

        def undo() -> None:
            if rig.poll() is None:
                rig.send_signal(signal.SIGUSR1)

        return injected_s, undo

    def _host_killed(self) -> tuple[float, Any]:
        assert self.bench is not None
        assert self.bench.rig is not None
        killed_s = time.monotonic()
        kill_hard(self.bench.rig)
        return killed_s, lambda: None

    def _host_stopped_2s(self) -> tuple[float, Any]:
        rig = self._rig()
        stopped_s = time.monotonic()
        rig.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        rig.send_signal(signal.SIGCONT)
        return stopped_s, lambda: None

    def _wall_clock_an_hour_on(self) -> tuple[float, Any]:
        self._rig().send_signal(signal.SIGUSR2)
        return time.monotonic(), lambda: None

    def _machine_under_load(self) -> tuple[float, Any]:
        stack = contextlib.ExitStack()
        for _ in range(3):
            stack.enter_context(busy_process())
        return time.monotonic(), stack.close

    def _rig(self) -> subprocess.Popen[str]:
        assert self.bench is not None
        assert self.bench.rig is not None
        return self.bench.rig.popen

    def _ended(self, case: Case, client: RigClient, test_id: str) -> dict[str, Any]:
        if case.name == "host_killed":
            time.sleep(0.2)
            assert self.bench is not None
            self.client = client = self._rig_on()
            status = client.status()
            if status["finished"] is not None and status["finished"]["test_id"] == test_id:
                return status["finished"]
            nothing = {"outcome": "killed", "reason": status["reason"] or "the rig was killed", "summary": {}}
            kept = next((self.bench.data / "recordings").glob(f"*_{test_id}.h5"), None)
            return {**nothing, "recording_path": str(kept) if kept else None}
        if case.name == "disk_slow":
            return self._ended_on_slow_disk(client, test_id)
        return client.wait_finished(test_id, timeout_s=25)

    def _ended_on_slow_disk(self, client: RigClient, test_id: str) -> dict[str, Any]:
        """Let the disk recover once the rig has noticed, as sealing takes as long as the disk does."""
        end_s = time.monotonic() + 6
        while client.status()["state"] in ("arming", "running") and time.monotonic() < end_s:
            time.sleep(0.02)
        self._rig().send_signal(signal.SIGUSR1)
        self._healed = True
        return client.wait_finished(test_id, timeout_s=25)

    def _repair(self, case: Case, verdict: Verdict, undo: Any) -> None:
        if case.name == "disk_slow" and self._healed:
            self._healed = False
        else:
            undo()
        self._condemned = case.name == "cell_unplugged"  # it comes back on another port: the rig file must be corrected
        client = self.client
        if client is None:
            return
        status = self._settled(client)
        if status["state"] == "ready":
            return
        if verdict.outcome != "completed" and not status["reason"]:
            verdict.wrong.append("stopped, but the status gives no reason")
        refused = client.ask("start", plan=default_plan("refused"))["problem"]
        if refused is None:
            verdict.wrong.append(f"a test could start while {status['state']}")
            self._drop()
            return
        if self._condemned:
            return
        end_s = time.monotonic() + 4
        while not (reply := client.ask("rearm", by="bench"))["ok"] and time.monotonic() < end_s:
            time.sleep(0.1)
        verdict.rearmed = reply["ok"]
        if not reply["ok"]:
            verdict.wrong.append(f"not re-armed: {reply['problem']['detail']}")
            self._drop()

    def _settled(self, client: RigClient) -> dict[str, Any]:
        return client.wait_state("ready", "latched", "uncertain", "disconnected", timeout_s=20)

    def _sealed_later(self, test_id: str) -> dict[str, Any] | None:
        """What re-arming sealed, once the disk had room again."""
        assert self.bench is not None
        path = next((self.bench.data / "recordings").glob(f"*_{test_id}.h5"), None)
        return None if path is None else {"recording_path": str(path), "summary": {}}

    def _felt_count(self) -> int:
        assert self.bench is not None
        return control(self.bench.emulator.ready["control"], {"cmd": "state"})["pulses_received"]

    def _felt(self, since: int) -> list[dict[str, Any]]:
        assert self.bench is not None
        return control(self.bench.emulator.ready["control"], {"cmd": "pulses", "since": since})["pulses"]

    def _delivered(self, since: int) -> list[dict[str, Any]]:
        return [pulse for pulse in self._felt(since) if pulse["delivered"]]

    def _ready(self) -> RigClient:
        """A rig that is ready; a new pair where the last one could not be repaired."""
        if self.client is not None and (self._condemned or self._settled(self.client)["state"] != "ready"):
            self._drop()
        self._condemned = False
        if self.client is None:
            self._made += 1
            options = "--noise-seed", str(self._made), "--arm", "held"
            self.bench = Bench(self.disk / f"bench{self._made}", *options, speed=self.speed)
            self.client = self._rig_on()
        for old in (self.disk).glob("bench*/data/recordings/*.h5"):
            old.unlink()
        return self.client

    def _rig_on(self) -> RigClient:
        assert self.bench is not None
        client = self.bench.start_rig(module=MODULE, watch=CLINIC_WATCH)
        client.ask("subscribe")
        return client

    _healed = _condemned = False

    def _drop(self) -> None:
        if self.bench is not None:
            with contextlib.suppress(OSError, ValueError):
                self.bench.close()
        self.bench = self.client = None
        if self.mounted:
            self._resize(f"{DISK_MB}m")
        for left in self.disk.iterdir():
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink()

"""Both lines: the stimulator says who it is and that it cannot stimulate, and the adapter opens."""

from __future__ import annotations

from stimrig.rig import devices
from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed
from stimrig.rig.errors import RigError

ORDER, TITLE, NEEDED = 20, "stimulator's line", True
FAULTS = {
    "lines_swapped": Fault(
        "the stimulator answers on the port that the rig file gives to the CAN adapter: the two are swapped",
        "exchange stimulator.port and load_cell.bus.channel in the rig file, or use the names below /dev/stimrig",
    ),
    "stimulator_silent": Fault(
        "the stimulator does not answer: it is off, its cable is loose, or the port is another device's",
        "switch it on, plug its cable in, and compare stimulator.port and stimulator.device with what is connected",
    ),
    "stimulator_locked": Fault(
        "another program holds the stimulator's port: two rigs on one device",
        "stop the other program (systemctl stop stimrig-rig), then check again",
    ),
    "stimulator_faulty": Fault(
        "the stimulator answers with an error, or says that it stimulates although it was stopped",
        "switch it off and on; if it says so again, it needs its maker",
    ),
    "adapter_fails": Fault(
        "the CAN adapter cannot be opened",
        "plug it in and bring it up (systemctl start stimrig-can@can0); compare load_cell.bus with what is connected",
    ),
}


async def look(bench: Bench) -> Finding:
    if bench.halted:
        raise NotDone(bench.halted)
    await bench.rig.open()
    status = bench.rig.status()
    if status.state == "ready":
        who = status.stimulator
        return passed(" ".join(str(who.get(name)) for name in ("device", "id", "firmware") if who.get(name)), "answers")
    bench.halted = status.reason
    return failed(await _fault(bench, status.reason), status.reason, "answers")


async def _fault(bench: Bench, reason: str) -> str:
    if not reason.startswith("stimulator"):
        return "adapter_fails"
    if "cannot be opened" in reason:
        return "stimulator_locked"
    if "no answer" not in reason:
        return "stimulator_faulty"
    return "lines_swapped" if await _answers_elsewhere(bench) else "stimulator_silent"


async def _answers_elsewhere(bench: Bench) -> bool:
    """Whether the stimulator answers on the adapter's port. Asking who it is stimulates nothing."""
    bus = bench.cell.get("bus") or {}
    if bus.get("interface") != "slcan":
        return False
    settings = bench.given.stimulator.model_copy(update={"port": str(bus["channel"]).partition("@")[0]})
    driver = devices.find("stimulator", settings.device).create(settings, bench.ears.as_machine())
    try:
        await driver.open()
    except RigError:
        return False
    driver.close()
    return True

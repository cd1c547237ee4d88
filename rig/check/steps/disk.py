"""The folder of the data: it can be written, and has room."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 10, "data folder", True
LEAST_BYTES = 500 * 2**20
FAULTS = {
    "disk_not_writable": Fault(
        "the data folder cannot be written",
        "give the rig's user the folder: chown stimrig-rig DATA_DIR; or correct data_dir in the rig file",
    ),
    "disk_full": Fault(
        "the disk of the data folder is full",
        "move old recordings to the backup disk, or give data_dir a larger disk",
    ),
}


async def look(bench: Bench) -> Finding:
    work, disk, place = bench.tasks.work, bench.ears.as_machine().disk, bench.folder
    try:
        await work(disk.make_folder, place)
        await work(disk.replace, place / "written.txt", b"written by the check of the rig\n")
        free = await work(disk.free_bytes, place)
    except OSError as error:
        fault = "disk_full" if error.errno in (28, 122) else "disk_not_writable"  # no space, or no quota left
        bench.halted = f"data_dir: {error.strerror}"
        return failed(fault, f"{bench.given.data_dir}: {error.strerror}", "can be written")
    bound, figure = f"at least {LEAST_BYTES / 2**20:.0f} MB free", f"{free / 2**20:.0f} MB free"
    if not (free >= LEAST_BYTES):
        bench.halted = f"data_dir: {figure}"
        return failed("disk_full", figure, bound)
    return passed(figure, bound)

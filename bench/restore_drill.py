"""How long a backup of some size takes to make, and to be restored for trial and compared: `--gb 5`.

The recordings are of random bytes in HDF5, as large as a long test's; a model is fitted once and stored for each of
them. Everything goes into a temporary folder below `--place`, which is removed in the end: about three times the size.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

import stimrig
from bench.common import parser
from stimrig.api.operation import backup, drill
from stimrig.api.operation.copying import manifest
from stimrig.api.store import Store
from stimrig.api.store.tables import Model, Participant, Recording
from stimrig.api.whole_file import sha256_of
from stimrig.identify.paper import simulate

RECORDING_MB = 5.0
NOW = "2026-01-01T08:00:00.000Z"


def document(folder: Path) -> bytes:
    """A MODEL.json."""
    model = stimrig.fit(simulate(0.02, 1)[0])
    return stimrig.save(model, folder / "MODEL.json").read_bytes()


def fill(rig: Path, api: Path, gigabytes: float, model: bytes) -> int:
    """Data folders of that size; how many recordings."""
    for folder in (rig / "journals", rig / "recordings", api):
        folder.mkdir(parents=True)
    store, random = Store(f"sqlite:///{api / 'stimrig.db'}"), np.random.default_rng(7)
    count, etag = max(1, round(gigabytes * 1000 / RECORDING_MB)), hashlib.sha256(model).hexdigest()
    with store.write() as session:
        session.add(Participant(code="P001", profile={}, created_utc=NOW, created_by="bench"))
        session.flush()
        for number in range(count):
            path = rig / "recordings" / f"20260101T080000Z_T{number:06}.h5"
            with h5py.File(path, "w") as file:
                file["torque/torque_nm"] = random.standard_normal(int(RECORDING_MB * 1e6 / 8))
            digest, made = sha256_of(path), {"participant": "P001", "created_utc": NOW}
            session.add(Recording(id=f"r{number}", path=str(path), file_sha256=digest, **made))
            session.flush()
            told = {"method": "maximum-likelihood", "document": model, "etag": etag, "created_by": "bench"}
            session.add(Model(id=f"m{number}", recording_id=f"r{number}", **told, **made))
    store.close()
    return count


def run(arguments: list[str] | None = None) -> dict[str, object]:
    """Make, verify, and compare once more by hand."""
    options = parser(__doc__)
    options.add_argument("--gb", type=float, default=5.0, help="size of the recordings, GB")
    options.add_argument("--place", type=Path, default=Path(tempfile.gettempdir()))
    given = options.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="stimrig-drill-", dir=given.place) as name:
        folder = Path(name)
        count = fill(folder / "rig", folder / "api", given.gb, document(folder))
        began_s = time.monotonic()
        kept = backup.create(folder / "rig", folder / "api", folder / "backups")
        made_s = time.monotonic() - began_s
        found = drill.verify(kept)
        sums = manifest(kept)["sha256"]
        source = {f"rig/recordings/{path.name}": sha256_of(path) for path in (folder / "rig/recordings").iterdir()}
        equal = all(sums[name] == digest for name, digest in source.items()) and found.files_same == len(sums)
    return {
        "gb": round(found.bytes / 1e9, 2), "recordings": count, "models": found.models, "rows": found.rows,
        "create_s": round(made_s, 1), "verify_s": found.seconds, "hashes_equal": equal,
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(run(sys.argv[1:])))

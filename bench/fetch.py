"""`python -m bench.fetch [--clients N] [--seconds S]`: the controller's fetch of the approved model.

One service process with a stored, approved model; N controllers, each with its key and its kept-alive connection, ask
with and without `If-None-Match`. `--every MS` gives each a pause, as a controller between trials
has; without it all ask as fast as they are answered.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.common import TOKEN, http_client, parser, spread
from stimrig.api.cli.child import Child
from tests.harness.patients import Patient, make_record


def csv_of_a_muscle() -> str:
    """A record of the paper's muscle."""
    record, _ = make_record(Patient(), np.random.default_rng(3), rate_hz=40.0)
    names = np.array(record.segment_names)[record.segment]
    rows = zip(record.time_s, record.pulse_width_us, record.torque_nm, names, strict=True)
    lines = [f"{time_s:.4f},{width:.2f},{torque:.5f},{name}" for time_s, width, torque, name in rows]
    return "time_s,pulse_width_us,torque_nm,segment\n" + "\n".join(lines) + "\n"


async def one(
    port: int,
    key: str,
    path: str,
    end_s: float,
    every_s: float,
    times: dict[int, list[float]],
    rng: random.Random | None,
) -> None:
    """A controller: a full fetch, then nine that ask whether anything is new, and so on. A bare client, so that the
    service is what is measured."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    etag, count = "", 0
    if rng is not None:  # a controller of its own asks when it likes, not when the others do
        await asyncio.sleep(rng.uniform(0.0, every_s))
    while time.perf_counter() < end_s:
        asked = f"If-None-Match: {etag}\r\n" if count % 10 else ""
        began = time.perf_counter()
        writer.write(f"GET {path} HTTP/1.1\r\nHost: bench\r\nAuthorization: Bearer {key}\r\n{asked}\r\n".encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        fields = dict(line.split(": ", 1) for line in head.splitlines()[1:] if line)
        await reader.readexactly(int(fields.get("content-length", 0)))
        times[int(head.split()[1])].append(time.perf_counter() - began)
        etag, count = fields["etag"], count + 1
        await asyncio.sleep(every_s if rng is None else every_s * rng.uniform(0.8, 1.2))
    writer.close()


def clients(
    port: int, keys: list[str], path: str, seconds: float, every_s: float, in_step: bool
) -> dict[int, list[float]]:
    """All of them, each at moments of its own, or all at the same instants."""

    async def run() -> dict[int, list[float]]:
        times: dict[int, list[float]] = {200: [], 304: []}
        end_s = time.perf_counter() + seconds
        own = [None if in_step else random.Random(number) for number in range(len(keys))]
        asked = (one(port, key, path, end_s, every_s, times, rng) for key, rng in zip(keys, own, strict=True))
        await asyncio.gather(*asked)
        return times

    return asyncio.run(run())


def main() -> None:
    """Measure and say."""
    made = parser(__doc__)
    made.add_argument("--clients", type=int, default=50)
    made.add_argument("--seconds", type=float, default=10.0)
    made.add_argument("--every", type=float, default=0.0, help="pause of each client, ms")
    made.add_argument("--in-step", action="store_true", help="all ask at the same instants")
    options = made.parse_args()
    with tempfile.TemporaryDirectory(prefix="stimrig-fetch-") as folder:
        api = Child("api", [sys.executable, "-m", "stimrig.api.web.server"], Path(folder) / "api.log")
        api.environment = {"STIMRIG_DATA_DIR": folder, "STIMRIG_PORT": "0", "STIMRIG_ADMIN_TOKEN": TOKEN}
        ready = api.start()
        try:
            with http_client(ready["url"]) as admin:
                admin.post("/v1/participants", json={"code": "P1"}).raise_for_status()
                sent = admin.post("/v1/participants/P1/recordings", content=csv_of_a_muscle()).raise_for_status().json()
                admin.post(f"/v1/models/{sent['model']['id']}/approve", json={"reason": "bench"}).raise_for_status()
                keys = [
                    admin.post("/v1/controller-keys", json={"name": f"c{k}"}).json()["key"]
                    for k in range(options.clients)
                ]
                size = len(admin.get("/v1/participants/P1/model").content)
            used = api.cpu_s() or 0.0
            path = "/v1/participants/P1/model"
            times = clients(ready["port"], keys, path, options.seconds, options.every / 1000, options.in_step)
            used = (api.cpu_s() or 0.0) - used
        finally:
            api.end()
    every = times[200] + times[304]
    ms = {f"{what}_ms": round(value, 2) for what, value in spread(every).items()}
    told = {"clients": options.clients, "pause_ms": options.every, "in_step": options.in_step, "model_bytes": size}
    told |= {
        "fetches_per_s": round(len(every) / options.seconds, 1),
        "server_ms_each": round(1e3 * used / len(every), 3),
    }
    told |= ms | {"p99_304_ms": round(spread(times[304])["p99"], 2)}
    print(json.dumps(told | {"load_average": os.getloadavg(), "cores": os.cpu_count()}))


if __name__ == "__main__":
    main()

"""`python -m bench.decisions --old TREE`: how long a decision takes, here and in a checkout of another commit.

Two services with emulated rigs, asked in turn, the first one first in every other round; each request alone is timed,
with the version that was read before it.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from bench.clinician_day import TOKEN, served

HERE = str(Path(__file__).parents[1])
HOME = "/v1/participants/P1"


def decide(http: httpx.Client, number: int) -> dict[str, float]:
    """Each decision once; its time in ms."""
    wanted: tuple[tuple[str, str, str, str, Any], ...] = (
        ("limits", "PUT", f"{HOME}/profile", HOME, {"current_ma": 10 + number % 5}),
        ("site", "PUT", f"{HOME}/muscle", HOME, {"side": ("left", "right")[number % 2]}),
        ("archive", "POST", f"{HOME}/archive", HOME, None), ("unarchive", "POST", f"{HOME}/unarchive", HOME, None),
        ("re-arm", "POST", "/v1/rearm", "/v1/rig", None),
    )  # fmt: skip
    took_ms = {}
    for name, method, path, document, body in wanted:
        if name == "re-arm":
            http.post("/v1/stop", json={"reason": "bench"}).raise_for_status()
        seen = http.get(document).headers.get("etag")
        began_s = time.perf_counter()
        answer = http.request(method, path, json=body, headers={"If-Match": seen} if seen else {})
        took_ms[name] = 1e3 * (time.perf_counter() - began_s)
        answer.raise_for_status()
    return took_ms


def main() -> None:
    """Print median and p95 of both, ms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--old", required=True)
    parser.add_argument("--rounds", type=int, default=60)
    asked = parser.parse_args()
    with served(tree=str(Path(asked.old).resolve())) as old, served(tree=HERE) as new:
        head = {"Authorization": f"Bearer {TOKEN}"}
        both = [httpx.Client(base_url=url, headers=head, timeout=60) for url in (old, new)]
        for http in both:
            http.post("/v1/participants", json={"code": "P1"}).raise_for_status()
        rounds: tuple[list[dict[str, float]], ...] = ([], [])
        for number in range(asked.rounds):
            for which in (0, 1) if number % 2 else (1, 0):
                rounds[which].append(decide(both[which], number))
    found: dict[str, Any] = {}
    for name in rounds[0][0]:
        ms = np.array([[took[name] for took in side] for side in rounds])
        p95 = np.percentile(ms, 95, axis=1)
        found[name] = {"old_median_p95_ms": [round(float(np.median(ms[0])), 1), round(float(p95[0]), 1)],
                       "new_median_p95_ms": [round(float(np.median(ms[1])), 1), round(float(p95[1]), 1)],
                       "paired_difference_median_ms": round(float(np.median(ms[1] - ms[0])), 1)}  # fmt: skip
        print(f"{name}: {json.dumps(found[name])}")
    print(json.dumps(found | {"rounds": asked.rounds, "load_average": os.getloadavg()[0]}))


if __name__ == "__main__":
    main()

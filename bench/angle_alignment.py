"""How far a recording's angles are from its torque: measured on the emulated wire, where the true times are known.

    python -m bench.angle_alignment [--tests N] [--seconds S] [--speed N]

Both sensors of the emulator count by clocks of known rates, so an angle's number says between which torques it was
taken. Prints a line for each way in which the angle comes: the method that the rig chose, the error that it states, and
the true one. The stated error contains that of the torque against the pulses; the true one is against the torque.
"""

from __future__ import annotations

import h5py
import numpy as np

from bench.common import emulated_rig, line, parser, table
from tests.harness.processes import RigClient, default_plan

WAYS: dict[str, tuple[str, ...]] = {
    "socketcand, clocks differ, jitter 0.2 ms": ("--angle-clock-ppm", "150", "--angle-jitter-us", "200"),
    "socketcand, in step with the cell": (),
    "slcan, clocks differ": ("--load-cell", "slcan", "--angle-clock-ppm", "150"),
    "slcan, 50 angles/s": ("--load-cell", "slcan", "--angle-rate-hz", "50", "--angle-clock-ppm", "-80"),
    "in the cell's frame": ("--angle", "in-cell"),
}


def main() -> None:
    """Print the table."""
    made = parser(__doc__)
    made.add_argument("--tests", type=int, default=3)
    made.add_argument("--seconds", type=float, default=10.0)
    made.add_argument("--speed", type=float, default=1.0)
    options = made.parse_args()
    heads = ["how the angle comes", "method", "stated, ms", "median, ms", "worst, ms", "drift, ppm"]
    print(*table(heads, []), sep="\n")
    for way, settings in WAYS.items():
        print(row(way, settings, options.tests, options.seconds, options.speed), flush=True)


def row(way: str, settings: tuple[str, ...], tests: int, seconds: float, speed: float) -> str:
    """One line: all tests of one way together."""
    with emulated_rig("--arm", "held", "--noise-seed", "7", *settings, speed=speed) as (_, client):
        found = [measured(client, settings, f"t{n}", seconds) for n in range(tests)]
    methods = ", ".join(sorted({method for method, _, _, _ in found}))
    stated = max(error_ms for _, error_ms, _, _ in found)
    off_ms = np.concatenate([errors_ms for _, _, errors_ms, _ in found])
    drift = max((ppm for _, _, _, ppm in found), key=abs)
    worst = off_ms[np.argmax(np.abs(off_ms))]
    return line([way, methods, f"{stated:.2f}", f"{np.median(off_ms):+.3f}", f"{worst:+.3f}", f"{drift:+.0f}"])


def measured(
    client: RigClient, settings: tuple[str, ...], test_id: str, seconds: float
) -> tuple[str, float, np.ndarray, float]:
    """Play a test: the method, the error that is stated, the true errors (ms), and their drift (ppm)."""
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}}
    steps = {"name": "steps", "sequence": "steps", "settings": {"on_s": seconds - 1.0, "off_s": 0.5, "repeats": 1}}
    reply = client.start(default_plan(test_id, segments=[rest, steps]))
    assert reply["ok"], reply
    event = client.wait_finished(test_id, timeout_s=seconds + 60)
    assert event["outcome"] == "completed", event
    given = dict(zip(settings[::2], settings[1::2], strict=True))
    rate_hz = float(given.get("--angle-rate-hz", "200")) * (1 + 1e-6 * float(given.get("--angle-clock-ppm", "0")))
    with h5py.File(event["recording_path"]) as file:
        angle, torque = file["angle"], file["torque"]
        time_s, counter = angle["time_s"][:], angle["counter"][:]
        if "in-cell" in settings:
            true_s = torque["time_s"][:][np.searchsorted(torque["host_time_s"][:], angle["host_time_s"][:])]
        else:
            true_s = np.interp(counter * 1600.0 / rate_hz, torque["counter"][:], torque["time_s"][:])
        off_ms = 1e3 * (time_s - true_s)[5:-5]
        return (
            str(angle.attrs["method"]),
            float(angle.attrs["error_ms"]),
            off_ms,
            1e3 * float(np.polyfit(time_s[5:-5], off_ms, 1)[0]),
        )


if __name__ == "__main__":
    main()

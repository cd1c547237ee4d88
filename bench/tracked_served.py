"""`python -m bench.tracked_served [--trials N]`: from a trial's last sample to the tracked model being served.

On the emulated rig in real time, with a fit after a test in the same run as reference. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from api.cli.launcher import Services
from api.client.rest import Client
from api.settings import Settings
from examples import ilc_controller as ilc

TOKEN = "bench-of-the-tracked-model"


def main() -> None:
    """Play trials of three seconds, and read what the service kept of each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=40)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stimrig-tracked-") as folder:
        settings = Settings(data_dir=Path(folder))
        settings.port = 0
        with Services(settings, ["--rate-hz", "400"], TOKEN) as services:
            client = Client(services.url, TOKEN)
            profile = {"current_ma": 20.0, "max_pulse_width_us": 300.0, "max_torque_nm": 30.0}
            client.make_participant("ILC", profile)
            test = client.run_test("ILC")
            client.approve(test["model_id"], "bench")
            service = ilc.Service(client, "ILC")
            up = np.linspace(0.0, 160.0, 40).round()
            for _ in range(options.trials):
                service.play(np.r_[up, np.full(40, 160.0), up[::-1]])
                client.approved_model("ILC", tracked=True)
            trials = client.tracking("ILC")["trials"]
    delays_s = [trial["delay_s"] for trial in trials if trial["delay_s"] is not None]
    fit_s = test["summary"]["last_sample_to_model_s"]
    median_s, p99_s = (float(np.quantile(delays_s, share)) for share in (0.5, 0.99))
    found = {
        "trials": len(trials), "followed": len(delays_s), "outcomes": sorted({trial["outcome"] for trial in trials}),
        "median_s": round(median_s, 3), "p99_s": round(p99_s, 3), "largest_s": max(delays_s),
        "fit_s": fit_s, "median_share_of_fit": round(median_s / fit_s, 4),
    }  # fmt: skip
    print(json.dumps(found))


if __name__ == "__main__":
    main()

"""The pictures of the page: `python -m bench.pictures [model] [joint] [muscles]` writes them to docs/img.

Without a name all of them. `model`: page.png and why.png, of a recording of a muscle with a hidden hysteresis. `joint`:
joint.png, of an emulated arm's isometric test and its guided tests, joined. `muscles`: two-muscles.png, of one test of
two. A service on the emulated rig, a clinician, and Debian's chromium.
"""

from __future__ import annotations

import io
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from bench.common import ROOT, http_client, parser, services, sign_in
from bench.moving_joint import as_record, guided_tests, joined
from bench.two_muscles import NAMES, PULSES_HZ, RATE_HZ, widths
from stimrig.hardware_sim import hidden_records
from stimrig.hardware_sim.arm_patient import arm_patient
from stimrig.hardware_sim.arm_records import record
from stimrig.hardware_sim.joint_records import draw_joint
from stimrig.hardware_sim.joint_records import record as made_of_two
from stimrig.identify.fitting import fit
from stimrig.identify.records.join import write_joined
from stimrig.rig import protocols
from tests.api.browser import CHROMIUM, PASSWORD, chart

IMAGES = ROOT / "docs" / "img"
WIDTH, HEIGHT, MARGIN, COLOURS = 1366, 768, 14, 128
TWO = 16
ARM = 3
"""Whose joint is shown: one of those that were developed on."""


def prepared(url: str, folder: Path) -> str:
    """A participant with a recording, and its diagnosis; the id of the model."""
    path = folder / "record.csv"
    hidden_records.write_csv(hidden_records.generate("recruitment_hysteresis", "strong", seed=4, rate_hz=400), path)
    with http_client(url) as http:
        model = str(taken(http, "P017", path)["model"]["id"])
        http.get(f"/v1/models/{model}/diagnosis").raise_for_status()
    return model


def prepared_joint(url: str, folder: Path) -> str:
    """A participant with the tests of a joint, joined; the id of the model of all of them."""
    arm = arm_patient(ARM)
    isometric = record(arm, "isometric", ARM)
    guided = guided_tests(arm, fit(as_record(isometric)), isometric, ARM)
    path = folder / "joint.csv"
    write_joined(joined([isometric, *guided]), path)
    with http_client(url) as http:
        recording = taken(http, "P018", path)["recording_id"]
        return str(
            http.post("/v1/participants/P018/models", json={"recordings": [recording]}).raise_for_status().json()["id"]
        )


def prepared_muscles(url: str, folder: Path) -> str:
    """A participant with the test of two muscles; the id of its model with all that the record asks for."""
    made = draw_joint(TWO)
    top = [float(muscle.base.largest_width_us) for muscle in made.muscles]
    widths_us, names = widths(protocols.several(NAMES), top)
    path = folder / "two.csv"
    path.write_text(as_table(made_of_two(made, *widths_us, seed=1), names))
    with http_client(url) as http:
        model = str(taken(http, "P019", path)["model"]["id"])
        http.get(f"/v1/models/{model}/diagnosis").raise_for_status()
    return model


def as_table(made: dict[str, Any], names: list[str]) -> str:
    """A record of two muscles as the table that is read."""
    segment = np.repeat(names, round(RATE_HZ / PULSES_HZ))
    columns = zip(made["time_s"], made["first_us"], made["second_us"], made["torque_nm"], segment, strict=True)
    head = ",".join(["time_s", *(f"{name}_pulse_width_us" for name in NAMES), "torque_nm,segment"])
    return "\n".join([head, *(f"{t:.5f},{a:g},{b:g},{nm:.5f},{name}" for t, a, b, nm, name in columns)]) + "\n"


def taken(http: Any, code: str, path: Path) -> dict[str, Any]:
    """What the service says of a new participant's recording."""
    http.post("/v1/participants", json={"code": code}).raise_for_status()
    headers = {"Content-Type": "text/csv"}
    sent = http.post(f"/v1/participants/{code}/recordings", content=path.read_bytes(), headers=headers)
    return sent.raise_for_status().json()


def keep(name: str, content: bytes) -> None:
    """Write a picture with few colours: below 300 kB."""
    path = IMAGES / f"{name}.png"
    picture = Image.open(io.BytesIO(content)).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1000} kB")


def cut(page: Page, above: str, below: str) -> bytes:
    """The page from the top of one part to the end of another, as PNG."""
    whole = Image.open(io.BytesIO(page.screenshot(full_page=True)))
    place = "document.querySelector('{}').getBoundingClientRect().{} + scrollY"
    upper, lower = (page.evaluate(place.format(*asked)) for asked in ((above, "top"), (below, "bottom")))
    part = io.BytesIO()
    whole.crop((0, int(upper - MARGIN), whole.width, int(lower + MARGIN))).save(part, "PNG")
    return part.getvalue()


def photograph(page: Page, url: str, model: str) -> None:
    """The model's first screen, then the missing effect and where the error sits."""
    page.goto(f"{url}/models/{model}")
    page.wait_for_selector(".why-head")
    chart(page, "overview")
    page.wait_for_timeout(1500)
    keep("page", page.screenshot())
    page.evaluate("for (const name of ['.effect', '#error']) document.querySelector(name).open = true")
    chart(page, "residual")
    page.wait_for_timeout(1500)
    keep("why", cut(page, ".effect", "#error"))


def photograph_joint(page: Page, url: str, model: str) -> None:
    """How the torque depends on the angle and the velocity of the joint."""
    page.goto(f"{url}/models/{model}")
    page.evaluate("document.querySelector('#joint').open = true")
    for name in ("joint_g", "joint_h"):
        chart(page, name)
    page.wait_for_timeout(1500)
    keep("joint", cut(page, "#joint", "#joint"))


def photograph_muscles(page: Page, url: str, model: str) -> None:
    """Each muscle's share under the measured torque, and what the muscles do to each other."""
    page.goto(f"{url}/models/{model}")
    page.wait_for_timeout(4000)
    keep("two-muscles", page.screenshot())


PICTURES = {
    "model": (prepared, photograph),
    "joint": (prepared_joint, photograph_joint),
    "muscles": (prepared_muscles, photograph_muscles),
}


def main() -> None:
    """Those that are asked for."""
    made = parser(__doc__)
    made.add_argument("names", nargs="*", metavar="model|joint|muscles", help="default: all")
    names = made.parse_args().names or list(PICTURES)
    if unknown := set(names) - set(PICTURES):
        made.error(f"no picture {sorted(unknown)[0]}; take one of {', '.join(PICTURES)}")
    with tempfile.TemporaryDirectory() as folder, services() as (running, _), sync_playwright() as playwright:
        chromium = os.environ.get("CHROMIUM", str(CHROMIUM))
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, locale="en-GB")
        sign_in(page, running.url, PASSWORD)
        for prepare, take in (PICTURES[name] for name in names):
            take(page, running.url, prepare(running.url, Path(folder)))
        browser.close()


if __name__ == "__main__":
    main()

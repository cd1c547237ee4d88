"""The README's pictures of the page: `python -m bench.pictures` writes docs/img/page.png and docs/img/why.png.

A service on the emulated rig, a clinician, a recording of a muscle with a hidden hysteresis, and Debian's chromium.
"""

from __future__ import annotations

import io
import os
import tempfile
from pathlib import Path

import httpx
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from api.cli.launcher import Services
from api.settings import Settings
from hardware_sim import hidden_records

IMAGES = Path(__file__).parents[1] / "docs" / "img"
TOKEN = "bench-of-the-pictures-of-the-page"
NAME, PASSWORD = "Ada", "correct horse battery"
WIDTH, HEIGHT, MARGIN, COLOURS = 1366, 768, 14, 128


def prepared(url: str, folder: Path) -> str:
    """A clinician, a participant with a recording, and its diagnosis; the id of the model."""
    record = folder / "record.csv"
    hidden_records.write_csv(hidden_records.generate("recruitment_hysteresis", "strong", seed=4, rate_hz=400), record)
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=180) as http:
        http.post("/v1/users", json={"name": NAME, "password": PASSWORD}).raise_for_status()
        http.post("/v1/participants", json={"code": "P017"}).raise_for_status()
        headers = {"Content-Type": "text/csv"}
        sent = http.post("/v1/participants/P017/recordings", content=record.read_bytes(), headers=headers)
        model = str(sent.raise_for_status().json()["model"]["id"])
        http.get(f"/v1/models/{model}/diagnosis").raise_for_status()
    return model


def keep(name: str, content: bytes) -> None:
    """Write a picture with few colours: below 300 kB."""
    path = IMAGES / f"{name}.png"
    picture = Image.open(io.BytesIO(content)).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1000} kB")


def photograph(page: Page, url: str, model: str) -> None:
    """Sign in, open the model, keep its first screen, then the missing effect and where the error sits."""
    page.goto(f"{url}/sign-in")
    page.fill("input[name=name]", NAME)
    page.fill("input[name=password]", PASSWORD)
    page.press("input[name=password]", "Enter")
    page.wait_for_url(f"{url}/")
    page.goto(f"{url}/models/{model}")
    page.wait_for_selector(".why-head")
    page.wait_for_selector("#torque .js-plotly-plot .main-svg")
    page.wait_for_timeout(1500)
    keep("page", page.screenshot())
    page.evaluate("for (const name of ['.effect', '#error']) document.querySelector(name).open = true")
    page.wait_for_selector("#error .js-plotly-plot .main-svg")
    page.wait_for_timeout(1500)
    whole = Image.open(io.BytesIO(page.screenshot(full_page=True)))
    place = "document.querySelector('{}').getBoundingClientRect().{} + scrollY"
    upper, lower = (page.evaluate(place.format(*asked)) for asked in ((".effect", "top"), ("#error", "bottom")))
    part = io.BytesIO()
    whole.crop((0, int(upper - MARGIN), whole.width, int(lower + MARGIN))).save(part, "PNG")
    keep("why", part.getvalue())


def main() -> None:
    """Both pictures."""
    with tempfile.TemporaryDirectory(prefix="stimrig-pictures-") as folder:
        settings = Settings(data_dir=Path(folder) / "data")
        settings.port = 0
        with Services(settings, [], TOKEN) as services, sync_playwright() as playwright:
            model = prepared(services.url, Path(folder))
            chromium = os.environ.get("CHROMIUM", "/usr/bin/chromium")
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, locale="en-GB")
            photograph(page, services.url, model)
            browser.close()


if __name__ == "__main__":
    main()

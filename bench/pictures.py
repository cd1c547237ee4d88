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
WIDTH, MARGIN, COLOURS = 1200, 14, 128


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
    """Sign in, open the model, keep its upper part and the section below it."""
    page.goto(f"{url}/sign-in")
    page.fill("input[name=name]", NAME)
    page.fill("input[name=password]", PASSWORD)
    page.press("input[name=password]", "Enter")
    page.wait_for_url(f"{url}/")
    page.goto(f"{url}/models/{model}")
    page.wait_for_selector("#why .js-plotly-plot .main-svg")
    page.wait_for_timeout(1500)
    place = "document.querySelector('{}').getBoundingClientRect().{} + scrollY"
    top, bottom = (page.evaluate(place.format(*asked)) for asked in (("#why", "top"), (".card.effect", "bottom")))
    whole = page.screenshot(full_page=True)
    picture = Image.open(io.BytesIO(whole))
    for name, upper, lower in (("page", 0, top), ("why", top - MARGIN, bottom + MARGIN)):
        part = io.BytesIO()
        picture.crop((0, int(upper), picture.width, int(lower))).save(part, "PNG")
        keep(name, part.getvalue())


def main() -> None:
    """Both pictures."""
    with tempfile.TemporaryDirectory(prefix="stimrig-pictures-") as folder:
        settings = Settings(data_dir=Path(folder) / "data")
        settings.port = 0
        with Services(settings, [], TOKEN) as services, sync_playwright() as playwright:
            model = prepared(services.url, Path(folder))
            chromium = os.environ.get("CHROMIUM", "/usr/bin/chromium")
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
            page = browser.new_page(viewport={"width": WIDTH, "height": 900}, locale="en-GB")
            photograph(page, services.url, model)
            browser.close()


if __name__ == "__main__":
    main()

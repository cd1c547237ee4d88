"""What is taken away is what was there: CSV of a recording, the report's pictures, the ramp's two directions."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts import model_charts
from stimrig.api.charts.figure import interpolate
from stimrig.api.charts.svg import svg, ticks
from stimrig.api.workers.curves import curves
from stimrig.api.workers.pool import WORKER
from tests.api.conftest import run_service, run_test
from tests.api.fake_rig import default_widths, muscle

Done = tuple[httpx.Client, dict[str, Any], Path]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Done]:
    """A test's recording and model, by real workers."""
    folder = tmp_path_factory.mktemp("export")
    for service in run_service(folder, short_dir, WORKER):
        with service.client() as client:
            client.timeout = 120
            client.post("/v1/participants", json={"code": "P1"})
            yield client, run_test(client, "P1", 120.0), folder


def test_csv_of_a_recording_is_the_recording(done: Done, tmp_path: Path) -> None:
    client, document, folder = done
    answer = client.get(f"{document['recording_url']}/csv")
    assert answer.headers["content-type"].startswith("text/csv")
    assert f"{document['recording_id']}.csv" in answer.headers["content-disposition"]
    path = tmp_path / "out.csv"
    path.write_bytes(answer.content)
    ours, theirs = identify.read(path), identify.read(folder / "recordings" / f"{document['recording_id']}.h5")
    np.testing.assert_allclose(ours.time_s, theirs.time_s, atol=1e-6)
    np.testing.assert_allclose(ours.pulse_width_us, theirs.pulse_width_us, rtol=1e-6)
    np.testing.assert_allclose(ours.torque_nm, theirs.torque_nm, rtol=1e-6, atol=1e-9)
    assert ours.segment_names == theirs.segment_names
    assert client.get("/v1/recordings/none/csv").status_code == 404
    again = client.post("/v1/participants/P1/recordings", content=answer.content).json()
    fits = again["model"]["fit_percent"], document["fit"]["fit_percent"]
    assert abs(fits[0] - fits[1]) < 0.2, "it can be taken in again and says the same"
    back = client.get(f"/v1/recordings/{again['recording_id']}/csv")
    assert back.content == answer.content


def test_report_holds_the_figures_and_no_script(done: Done) -> None:
    client, document, _folder = done
    page = client.get(f"/models/{document['model_id']}/report").text
    for words in ("Muscle model of P1", "Torque (N·m)", "Pulse width", "Steady torque (N·m)", "SHA-256", "allows"):
        assert words in page, words
    assert "<script" not in page and page.count("<svg") == 3
    assert len(page.encode()) < 600_000


@cache
def measured(after: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """A made-up muscle's record, and the model fitted to it; `after` bends the torque."""
    widths, segments = default_widths()
    torque = np.array(muscle(widths, 400.0)).reshape(-1, 5).mean(axis=1)
    time_s = np.arange(torque.size) / 80
    width = np.repeat(widths, 2)
    name = np.full(torque.size, "rest", dtype="U16")
    for segment in segments:
        name[(time_s >= segment["start_s"]) & (time_s < segment["end_s"])] = segment["name"]
    if after is not None:
        torque = torque + after(width)
    record = identify.Record.from_arrays(time_s, width, torque, name)
    model = identify.fit(record)
    return model.to_dict(), curves(model, record)


def distance(found: dict[str, Any]) -> float:
    """Mean of falling minus rising at the widths that both have, N·m."""
    up, down = found["rising"], found["falling"]
    at = np.linspace(80, 250, 30)
    falling = np.interp(at, down["pulse_width_us"], down["torque_nm"])
    return float(np.mean(falling - np.interp(at, up["pulse_width_us"], up["torque_nm"])))


def test_both_directions_of_the_ramp_lie_on_the_curve_of_a_muscle_without_hysteresis() -> None:
    document, drawn = measured()
    found = model_charts.ramp_points(document, drawn)
    known = document["recruitment"]
    for points in found.values():
        curve = [interpolate(width, known["pulse_width_us"], known["torque_nm"]) for width in points["pulse_width_us"]]
        assert np.abs(np.array(points["torque_nm"]) - curve).max() < 0.12
    assert abs(distance(found)) < 0.06


def test_a_muscle_with_hysteresis_shows_two_curves() -> None:
    def lag(width: Any) -> Any:
        falls = np.zeros(width.size)
        slope = np.diff(width, prepend=width[0])
        falls[(slope < 0) | (np.roll(slope, 1) < 0)] = 1.0
        ramp = (slope != 0) | (np.roll(slope, 1) != 0)
        return np.where(ramp & (falls > 0), 0.8, 0.0)

    document, drawn = measured(lag)
    found = model_charts.ramp_points(document, drawn)
    assert distance(found) > 0.2, "less than the 0.8 N·m put in: the fitted lag takes a part of it upon itself"
    figure = model_charts.recruitment(document, drawn)
    assert {"ramp up", "ramp down"} <= {trace["name"] for trace in figure["data"]}


def test_a_recording_without_a_ramp_has_no_directions() -> None:
    document, drawn = measured()
    still = {**drawn, "pulse_width_us": [0.0, 200.0] * (len(drawn["time_s"]) // 2), "time_s": drawn["time_s"]}
    assert model_charts.ramp_points(document, still) == {}
    assert model_charts.ramp_points(document, {**drawn, "time_s": [0.0]}) == {}


def test_still_pictures_are_whole_svg_with_the_values_in_their_place() -> None:
    document, drawn = measured()
    for name, figure in model_charts.model_figures(document, drawn).items():
        picture = ElementTree.fromstring(str(svg(figure, 600.0, label=f"<{name}> & more")))
        texts = {text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")}
        assert figure["layout"]["xaxis"]["title"]["text"] in texts
        assert picture.attrib["aria-label"] == f"<{name}> & more"
    line = {"type": "scatter", "x": [0, 10], "y": [0.0, 1.0], "name": "a", "line": {"color": "#000", "width": 1}}
    figure = {"data": [line], "layout": {"height": 200, "xaxis": {}, "yaxis": {}}}
    (path,) = ElementTree.fromstring(str(svg(figure, 300.0))).iter("{http://www.w3.org/2000/svg}path")
    start, end = (tuple(map(float, point.split())) for point in path.attrib["d"][1:].split("L"))
    assert start[0] < end[0] <= 300 and start[1] > end[1] >= 0, "up is up"


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 7.9), (0.001, 0.004), (0.0, 47.7)])
def test_ticks_are_round_and_within(low: float, high: float) -> None:
    found = ticks(low, high, 5)
    assert 2 <= len(found) <= 11 and low - 1e-9 <= found[0] and found[-1] <= high + 1e-9
    assert np.ptp(np.diff(found)) < 1e-9

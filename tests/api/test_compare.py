"""Two to six models side by side, and what a model's page says of the last approved session."""

from __future__ import annotations

import re
from dataclasses import replace

import httpx
import pytest

from tests.api.conftest import Service, shared_service
from tests.harness import sessions
from tests.harness.muscle import Patient
from tests.harness.sessions import Planned

WEAKER = replace(Patient(), gain=0.82 * Patient().gain)
DAYS = (
    Planned(Patient(), 0.0), Planned(Patient(), 3.0, approved=False), Planned(WEAKER, 7.0),
    Planned(WEAKER, 9.0, current_ma=25.0), Planned(Patient(), 12.0), Planned(Patient(), 14.0), Planned(WEAKER, 16.0),
)  # fmt: skip


service = shared_service()


@pytest.fixture(scope="module")
def ids(service: Service) -> list[str]:
    context = service.app.state.context
    return sessions.make(context.store, context.settings.recordings_dir, "P017", list(DAYS))


def cells(page: str, figure: str) -> list[tuple[str, str]]:
    """Of each model what a figure's row shows: the value, and the difference with its mark."""
    row = next(row for row in re.findall(r"<tr>.*?</tr>", page, re.S) if f'<th scope="row">{figure}' in row)
    found = []
    for cell in re.findall(r'<td class="num">(.*?)</td>', row, re.S):
        value, _, more = cell.partition("<span")
        found.append((value, re.sub(r"<[^>]+>|^[^>]*>", "", more)))
    return found


def compared(client: httpx.Client, ids: list[str], **more: str) -> str:
    answer = client.get("/compare", params={"model": ids, **more})
    assert answer.status_code == 200, answer.text
    return answer.text


def test_six_models_with_their_differences_to_the_oldest(
    service: Service, ids: list[str], client: httpx.Client
) -> None:
    page = compared(client, ids[5:0:-1] + ids[:1])
    found = cells(page, "Plateau")
    assert len(found) == 6 and found[0][1] == ""
    values = [float(value.split(" ±")[0]) for value, _ in found]
    assert values[2] == pytest.approx(0.82 * values[0], rel=0.01)
    assert [number for number, (_, difference) in enumerate(found) if difference[:1] in "▲▼" and difference] == [2]
    assert found[2][1].startswith("▼ −1.2") and " ± 0.2" in found[2][1]
    assert found[3][1] == "" and "threshold and plateau are not compared" in page  # at another current
    assert cells(page, "Time constant")[3][1] != ""
    assert page.count('class="sample"') == 6 and len(set(re.findall(r'stroke="(#\w+|var[^"]+)"', page))) >= 6


def test_another_one_is_the_reference(service: Service, ids: list[str], client: httpx.Client) -> None:
    page = compared(client, [ids[0], ids[2]], reference=ids[2])
    found = cells(page, "Plateau")
    assert found[1][1] == "" and found[0][1].startswith("▲ +1.2")


@pytest.mark.parametrize("count", [1, 7])
def test_too_few_and_too_many(service: Service, ids: list[str], client: httpx.Client, count: int) -> None:
    answer = client.get("/compare", params={"model": ids[:count]}, headers={"Accept": "text/html"})
    assert answer.status_code == 422 and "choose 2 to 6 models" in answer.text
    same = client.get("/compare", params={"model": [ids[0], ids[0]]})
    assert same.status_code == 422


def test_the_models_page_says_what_changed(service: Service, ids: list[str], client: httpx.Client) -> None:
    weaker = client.get(f"/models/{ids[2]}", params={"diagnose": 0}).text
    assert "Plateau 18\u00a0% lower than on 03 Aug 2026, more than twice its uncertainty." in weaker
    same = client.get(f"/models/{ids[1]}", params={"diagnose": 0}).text
    assert "Nothing changed beyond its uncertainty since 03 Aug 2026." in same
    first = client.get(f"/models/{ids[0]}", params={"diagnose": 0}).text
    assert 'class="changes' not in first


def test_the_participants_page_leads_to_the_trend(service: Service, ids: list[str], client: httpx.Client) -> None:
    assert 'href="/participants/P017/trend"' in client.get("/participants/P017").text

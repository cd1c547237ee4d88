"""What a service keeps is in the map of data (docs/safety/data-map.toml)."""

from __future__ import annotations

import httpx

from deploy.technical_file import checks, places
from tests.api.conftest import Service, run_test


def test_every_file_of_a_service_with_a_test_is_in_the_map(
    service: Service, client: httpx.Client, participant: str
) -> None:
    run_test(client, participant)
    folder = service.context.settings.data_dir
    assert any(folder.rglob("*"))
    assert checks.unmapped(folder, places.read()["data-map"]) == []

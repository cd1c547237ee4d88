"""A turn that is given up while it is waited for is nobody's: the next one gets it."""

from __future__ import annotations

import asyncio

import pytest

from api.store import Store
from api.store.holds import Among
from tests.api.test_several_services import address
from tests.harness.postgres import Cluster

__all__ = ["address"]


def test_a_turn_that_is_given_up_is_let_go(cluster: Cluster, address: str) -> None:
    del cluster
    stores = [Store(address) for _ in range(2)]
    one, other = (Among(store.engine) for store in stores)

    async def wants() -> None:
        async with one.turn("rig"):
            pytest.fail("it was given up")

    async def both() -> None:
        async with other.turn("rig"):
            waiting = asyncio.create_task(wants())
            await asyncio.sleep(0.3)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
        await asyncio.sleep(0.3)  # it comes to who no longer wants it
        async with other.turn("rig"):
            pass

    asyncio.run(both())
    for holds, store in zip((one, other), stores, strict=True):
        holds.close()
        store.close()

"""What a participant's models begin with: the effects of their first one, and for who has none those of the site."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from api.errors import ApiError
from api.settings import Settings
from api.store import Store
from api.store.tables import Model
from api.structure import in_words
from api.workers.pool import Call, Pool
from api.workers.process import WORKER, Places


class StartingEffects:
    """The fit after a test or an upload, in the participant's structure."""

    def __init__(self, store: Store, pool: Pool, settings: Settings) -> None:
        self.store, self.pool, self.settings = store, pool, settings

    def structure(self, participant: str) -> list[str]:
        """Ids of the effects that the participant's next recording is fitted with; none for the plain structure."""
        rows = self.store.all(Model, Model.participant == participant, order=Model.created_utc, limit=1)
        return list(rows[0].effects if rows else self.settings.structure)

    async def fit(
        self, participant: str, path: str, on_call: Callable[[Call], None] | None = None, **how: Any
    ) -> tuple[dict[str, Any], str]:
        """The model of a recording, and what had to be left out of its structure (empty where nothing had).

        A recording in which nothing looks like an effect is fitted in the plain structure: a test that a person went
        through gives a model.

        Raises
        ------
        ApiError
            The recording gives no model in the plain structure either.
        """

        def begun(**more: Any) -> Call:
            call = self.pool.submit("fit", data=path, **more, **how)
            if on_call is not None:
                on_call(call)
            return call

        effects = await asyncio.to_thread(self.structure, participant)
        if not effects:
            return await begun().result, ""
        try:
            return await begun(effects=effects).result, ""
        except ApiError as error:
            if error.code != "data":
                raise
            why = error.detail
        found = await begun().result
        return found, f"Fitted in the plain structure, not with {in_words(effects).replace('_', ' ')}: {why}"


async def refuse_unknown(settings: Settings, worker: tuple[str, ...] = WORKER) -> None:
    """Refuse effects of the site's own that cannot be used, and a structure that names what is not in the library.

    A worker reads the library.

    Raises
    ------
    OSError
        Which, and what there is; or why the library cannot be read.
    """
    if not settings.structure and not settings.effects_dir:
        return
    reads = [settings.effects_dir] if settings.effects_dir else []
    pool = Pool(1, worker, Places(reads))
    try:
        found = await pool.submit("effects").result
    except ApiError as error:
        raise OSError(f"the library of effects cannot be read: {error}") from error
    finally:
        await pool.close()
    known = sorted(entry["id"] for entry in found["effects"])
    unknown = [effect for effect in settings.structure if effect not in known]
    if unknown:
        raise OSError(f"STIMRIG_STRUCTURE: no effect is called {', '.join(unknown)}. Take some of {', '.join(known)}.")

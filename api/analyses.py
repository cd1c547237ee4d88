"""What workers find out about a model, kept with it: comparison, diagnosis; and effects added to it."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from api.clock import Clock
from api.fitting import Fitting, Job
from api.store import Store
from api.store.tables import Analysis, Model, Recording
from api.versions import Versions


class Analyses:
    """Asks the workers once for each finding; a second asker shares the first one's job."""

    def __init__(self, store: Store, clock: Clock, fitting: Fitting, versions: Versions) -> None:
        self.store, self.clock, self.fitting, self.versions = store, clock, fitting, versions
        self.running: dict[tuple[str, str], Job] = {}

    def path(self, model: Model) -> str:
        """Where the model's recording lies."""
        recording: Recording = self.store.get(Recording, model.recording_id)
        return recording.path

    async def comparison(self, model: Model) -> dict[str, Any]:
        """Measurement against model."""
        return await self._kept(model, "comparison", model_json=model.document.decode())

    async def curves(self, model: Model) -> dict[str, Any]:
        """Measured, predicted and commanded curves, thinned to what a screen shows."""
        return await self._kept(model, "curves", model_json=model.document.decode())

    async def diagnosis(self, model: Model) -> dict[str, Any]:
        """What is missing."""
        return await self._kept(model, "diagnosis")

    def known(self, model_id: str, kind: str) -> dict[str, Any] | None:
        """A finding if it has been made."""
        row = self.store.get(Analysis, (model_id, kind))
        return row.document if row else None

    async def _kept(self, model: Model, kind: str, **arguments: Any) -> dict[str, Any]:
        known = await asyncio.to_thread(self.known, model.id, kind)
        if known is not None:
            return known
        key = (model.id, kind)
        job = self.running.get(key)
        if job is None:
            path = await asyncio.to_thread(self.path, model)
            job = self.running[key] = self.fitting.submit(kind, data=path, **arguments)
            job.result.add_done_callback(lambda _future: self.running.pop(key, None))
        found = await asyncio.shield(job.result)
        await asyncio.to_thread(self._keep, model.id, kind, found)
        return found

    def _keep(self, model_id: str, kind: str, found: dict[str, Any]) -> None:
        with self.store.write() as session:
            session.merge(Analysis(model_id=model_id, kind=kind, document=found, created_utc=self.clock.utc()))

    async def add_effects(self, model: Model, added: list[str], by: str) -> Model:
        """A new version: the model's effects and these, fitted together anew."""
        effects = list(dict.fromkeys([*model.effects, *added]))
        path = await asyncio.to_thread(self.path, model)
        job = self.fitting.submit("fit", data=path, method=model.method, effects=effects)
        found = await asyncio.shield(job.result)
        return await asyncio.to_thread(
            self.versions.add, found["json"], model.participant, model.recording_id, by, model.id, ",".join(added)
        )

    async def improve(self, model: Model, by: str) -> tuple[dict[str, Any], list[Model]]:
        """Effects added one by one while the evidence lasts, each step a version."""
        path = await asyncio.to_thread(self.path, model)
        found = await asyncio.shield(self.fitting.submit("improve", data=path).result)
        rows, parent = [], model.id
        for step, document in zip(found["steps"], found["models"], strict=True):
            row = await asyncio.to_thread(
                self.versions.add,
                json.dumps(document),
                model.participant,
                model.recording_id,
                by,
                parent,
                step["added"],
            )
            rows.append(row)
            parent = row.id
        return {key: value for key, value in found.items() if key != "models"}, rows

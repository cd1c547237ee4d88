"""Comparison, curves and diagnosis of a model, computed by workers and stored with it; adds effects to a model."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple
from uuid import uuid4

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, require_found
from stimrig.api.jobs.job import Job
from stimrig.api.jobs.pool import Pool
from stimrig.api.models import explanation, stored_model
from stimrig.api.models.registry import Versions
from stimrig.api.settings import Settings
from stimrig.api.store import Store
from stimrig.api.store.tables import Analysis, Model, Recording

log = logging.getLogger("stimrig.analyses")
OnCall = Callable[[Job], None]
"""Takes the job of a worker that begins: a page shows its progress."""
DIAGNOSIS, OWN_DIAGNOSIS = "diagnosis", "diagnosis of its structure"
"""Names of the stored search for what is missing: from the plain structure, and from a version's own structure."""
IMPROVEMENT = "improvement"
"""The models of a search, stored separately."""


def is_plain(model: Model) -> bool:
    """Return whether the version has the plain structure: no effects around f(u) and a G of second order."""
    return not model.effects and stored_model.is_plain(stored_model.read(model))


class SearchRow(NamedTuple):
    """The search that tells what a version lacks: where it is stored, and which of its models has that structure."""

    place: Model
    kind: str
    number: int
    diagnosis: dict[str, Any] | None
    """Of that model; None while there is none."""


class Analyses:
    """Asks the workers once for each finding; a second asker shares the job of the first."""

    def __init__(self, store: Store, clock: Clock, pool: Pool, versions: Versions, settings: Settings) -> None:
        self.store, self.clock, self.pool, self.versions = store, clock, pool, versions
        self.settings = settings
        self.running: dict[tuple[str, str], Job] = {}
        """Begun and not kept yet."""
        self._library: list[str] | None = None

    def path(self, recording_id: str) -> str:
        """Return the path of a recording."""
        recording = self.store.get(Recording, recording_id)
        return require_found(recording, "recording", recording_id, "A model's document names its recording.").path

    async def comparison(self, model: Model, recording_id: str | None = None) -> dict[str, Any]:
        """Compare measurement and model; with the id of another recording, the model and that one."""
        kind, of = "comparison", recording_id or model.recording_id
        if of != model.recording_id:
            kind = f"comparison {hashlib.sha256(of.encode()).hexdigest()[:16]}"
        return await self._find(model, kind, "comparison", of, model_json=stored_model.text(model))

    async def curves(self, model: Model) -> dict[str, Any]:
        """Return measured, predicted and commanded curves, thinned to what a screen shows."""
        return await self._find(model, "curves", "curves", model_json=stored_model.text(model))

    async def diagnosis(self, model: Model, on_call: OnCall | None = None) -> dict[str, Any]:
        """Diagnose what the structure of a model lacks; versions whose structures one search contains share it."""
        return (await self._diagnose(model, on_call))[1]

    async def _diagnose(self, model: Model, on_call: OnCall | None) -> tuple[SearchRow, dict[str, Any]]:
        row = await asyncio.to_thread(self._search_of, model)
        structure = {"model_json": stored_model.text(model)} if row.kind == OWN_DIAGNOSIS else {}
        search = await self._find(row.place, row.kind, "diagnosis", on_call=on_call, **structure)
        return row, _rows(search)[row.number]

    def _search_of(self, model: Model) -> SearchRow:
        """Return the search from the plain structure, stored with the recording's first version, or the version's own.

        A version is not searched again if a model of the plain one's search has its structure.
        """
        first = self.store.first(Model, Model.recording_id == model.recording_id, order=Model.created_utc)
        rows = _rows(self.known(first.id, DIAGNOSIS))
        if is_plain(model):
            return SearchRow(first, DIAGNOSIS, 0, rows[0] if rows else None)
        structure = {*stored_model.structure(stored_model.read(model)).values()}
        for number, row in enumerate(rows):
            if structure and {*row.get("structure", ())} == structure:
                return SearchRow(first, DIAGNOSIS, number, row)
        rows = _rows(self.known(model.id, OWN_DIAGNOSIS))
        return SearchRow(model, OWN_DIAGNOSIS, 0, rows[0] if rows else None)

    def known_diagnosis(self, model: Model) -> dict[str, Any] | None:
        """Return the diagnosis, or None while there is none."""
        return self._search_of(model).diagnosis

    def known(self, model_id: str, kind: str) -> dict[str, Any] | None:
        """Return a stored analysis, or None."""
        row = self.store.get(Analysis, (model_id, kind))
        return row.document if row else None

    async def _find(
        self, model: Model, kind: str, verb: str, recording_id: str | None = None, *,
        on_call: OnCall | None = None, **arguments: Any,
    ) -> dict[str, Any]:  # fmt: skip
        """Return a stored analysis; else have a worker do the verb, and store it as `kind`."""
        key = (model.id, kind)
        path = await asyncio.to_thread(self.path, recording_id or model.recording_id)
        if key not in self.running and (known := await asyncio.to_thread(self.known, *key)) is not None:
            return known
        call = self.running.get(key)
        if call is None:
            # A page waits for its curves, which take a fraction of a second, and not for a diagnosis.
            urgent = verb != "diagnosis"
            call = self.running[key] = self.pool.submit(verb, urgent=urgent, data=path, **arguments)
        if on_call is not None:
            on_call(call)
        try:
            result = await asyncio.shield(call.result)
            return await asyncio.to_thread(self._store_result, *key, result)
        finally:
            if call.result.done() and self.running.get(key) is call:
                del self.running[key]

    def _store_result(self, model_id: str, kind: str, result: dict[str, Any]) -> dict[str, Any]:
        """Store a diagnosis apart from the models of its search; return the analysis as it is read again."""
        parts = {kind: {name: part for name, part in result.items() if name != IMPROVEMENT}}
        if IMPROVEMENT in result:
            parts[f"{IMPROVEMENT} of {kind}"] = result[IMPROVEMENT]
        with self.store.write() as session:
            for name, document in parts.items():
                session.merge(Analysis(model_id=model_id, kind=name, document=document, created_utc=self.clock.utc()))
        return parts[kind]

    async def run(self, verb: str, on_call: OnCall | None = None, **arguments: Any) -> dict[str, Any]:
        """Have a worker do a verb; it is cancelled with the caller."""
        call = self.pool.submit(verb, **arguments)
        if on_call is not None:
            on_call(call)
        return await call.result

    # ---- versions -------------------------------------------------------------------------------------------

    async def add_effects(
        self, model: Model, added: list[str], by: str, *, force: bool = False, reason: str = "",
        on_call: OnCall | None = None,
    ) -> Model:  # fmt: skip
        """Fit the model's effects and the added ones together, as a new version.

        Raises ApiError: 409 an effect is in it already, or the recording does not ask for it and nobody forces it; 422
        no such effect, or the data do not allow the fit.
        """
        added = list(dict.fromkeys(added))
        if twice := [effect for effect in added if effect in model.effects]:
            detail = f"{', '.join(twice)} is in {model.id} already. Name effects it does not hold."
            raise ApiError(409, "effect-present", "The effect is in the model", detail)
        await self.check_known(added)
        effects = [*model.effects, *added]
        same = await asyncio.to_thread(self.versions.child_with, model, effects, [] if force else added)
        if same is not None:
            return same
        if force and not reason.strip():
            detail = "The evidence is against this effect. Give a reason; it is kept in the audit trail."
            raise ApiError(422, "reason-missing", "Adding an effect against the evidence needs a reason", detail)
        if force:
            diagnosis = await asyncio.to_thread(self.known_diagnosis, model)
        else:
            diagnosis = await self.diagnosis(model, on_call)
        against = dict.fromkeys(added, "") if diagnosis is None else explanation.refusals(diagnosis, added)
        if against and not force:
            detail = " ".join(f"{effect}: {words}" for effect, words in against.items())
            detail += " To add it against the evidence, send `force` and a reason; the held-out error shows its effect."
            title = "The recording gives no evidence for this effect"
            raise ApiError(409, "effect-not-there", title, detail, reasons=against)
        document = await asyncio.to_thread(self._searched, model, effects)
        if document is None:
            free = {row["effect"]: f"{row['effect']}:{row['form']}" for row in (diagnosis or {}).get("free") or []}
            forms = free | stored_model.structure(stored_model.read(model))
            with_forms = [forms.get(effect, effect) for effect in effects]
            path = await asyncio.to_thread(self.path, model.recording_id)
            fitted = await self.run("fit", on_call, data=path, method=model.method, effects=with_forms)
            document = json.loads(fitted["json"])

        def store() -> Model:
            row = self._child(model, added, document, by, list(against))
            if against or reason:
                action = "force effect" if against else "add effect"
                self.store.note(self.clock, by, action, row.id, effects=added, reason=reason)
            return row

        return await asyncio.to_thread(store)

    def _searched(self, model: Model, effects: list[str]) -> dict[str, Any] | None:
        """Return the model with these effects, if the search for what a version lacks contains it."""
        row = self._search_of(model)
        improvement = self.known(row.place.id, f"{IMPROVEMENT} of {row.kind}") or {"models": []}
        for document in improvement["models"]:
            if document["method"] == model.method and {each["id"] for each in document["effects"]} == {*effects}:
                return document
        return None

    async def check_known(self, effects: list[str]) -> None:
        """Refuse effects that are not in the library."""
        if self._library is None:
            self._library = sorted(entry["id"] for entry in (await self.run("effects"))["effects"])
        if unknown := [effect for effect in effects if effect not in self._library]:
            detail = f"There is no effect {', '.join(unknown)}. Take one of {', '.join(self._library)}."
            raise ApiError(422, "unknown-effect", "No such effect", detail)

    async def improve(self, model: Model, by: str, on_call: OnCall | None = None) -> tuple[dict[str, Any], list[Model]]:
        """Add effects to the structure of a model one by one while the evidence lasts, each step a version.

        They descend from the version whose structure was diagnosed; of the plain one there may be several.
        """
        row, diagnosis = await self._diagnose(model, on_call)

        def store() -> tuple[dict[str, Any], list[Model]]:
            improvement = self.known(row.place.id, f"{IMPROVEMENT} of {row.kind}")
            assert improvement is not None, "kept with the diagnosis"
            rows = [model]
            if (row.kind, row.number) == (DIAGNOSIS, 0):
                rows = [next((each for each in [row.place, *self.versions.ancestry(model)] if is_plain(each)), model)]
            first, *steps = improvement["steps"][row.number :]
            for step, document in zip(steps, improvement.pop("models")[row.number + 1 :], strict=True):
                rows.append(self._child(rows[-1], [step["added"]], document, by))
                step["model_id"] = rows[-1].id
            steps = [{**first, "added": None, "model_id": rows[0].id}, *steps]
            about = {key: diagnosis[key] for key in ("verdict", "structure")}
            return {**improvement, **about, "steps": steps}, rows

        return await asyncio.to_thread(store)

    def _child(
        self, parent: Model, added: list[str], document: dict[str, Any], by: str, forced: Sequence[str] = ()
    ) -> Model:
        """Return the child with these added effects; create it from the document where there is none."""
        same = self.versions.child_with(parent, [*parent.effects, *added], set(added) - set(forced))
        if same is not None:
            return same
        stored = self.store.get(Model, document["model_id"])
        if stored is not None and stored.parent_id != parent.id:  # one search serves versions of several descents
            document["model_id"] = str(uuid4())
        stored_model.mark_without_evidence(document, [*parent.fit["without_evidence"], *forced])
        document["extra"] = {**(document.get("extra") or {}), "parent": parent.id}
        of = (parent.participant, parent.recording_id)
        return self.versions.add(json.dumps(document), *of, by, parent.id, ",".join(added))


def _rows(search: dict[str, Any] | None) -> list[dict[str, Any]]:
    """Return the diagnoses of a search's models; a search that an older version stored is that of its first one."""
    return [] if search is None else search.get("rows", [search])

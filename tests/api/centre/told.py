"""A rig's side of decision 0013, written from its text alone: a chain of items, and its files."""

from __future__ import annotations

import hashlib
import json
import secrets
from typing import Any

import httpx

ZEROS = "0" * 64
HASHED = ("seq", "kind", "key", "sha256", "file", "file_bytes", "at_utc", "previous")
AT = "2026-03-02T08:00:00.000Z"


def canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def sha256(data: str | bytes) -> str:
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


class Teller:
    """A rig that keeps its chain in memory."""

    def __init__(self, after: dict[str, Any] | None = None) -> None:
        self.chain = secrets.token_hex(16)
        self.items: list[dict[str, Any]] = []
        self.files: dict[str, bytes] = {}
        self.add("begin", self.chain, {"after": after})

    def add(self, kind: str, key: str, body: dict[str, Any], data: bytes | None = None, at: str = AT) -> dict[str, Any]:
        """Append an item; with a file if there is one."""
        item = {"seq": len(self.items) + 1, "kind": kind, "key": key, "body": body, "sha256": sha256(canonical(body))}
        item |= {"file": None if data is None else sha256(data), "file_bytes": None if data is None else len(data)}
        item |= {"at_utc": at, "previous": self.items[-1]["hash"] if self.items else ZEROS}
        item["hash"] = sha256(canonical({name: item[name] for name in HASHED}))
        self.items.append(item)
        if data is not None:
            self.files[item["file"]] = data
        return item

    def session(self, code: str = "P017", day: str = "2026-03-02", number: int = 0, **more: Any) -> bytes:
        """A day: test, recording, model, approval; the recording's bytes."""
        at, name = f"{day}T08:{number:02}:00.000Z", f"{day}-{code}-{number}"
        data = f"HDF5 of {name}{more.get('salt', '')}".encode() * 50
        model = canonical({"model_id": f"m-{name}"}).encode()
        fit = {"verdict": more.get("verdict", "usable"), "fit_percent": 91.5, "noise_sd_nm": 0.12, "figures": {
            "threshold_us": {"value": 101.0 + number, "sd": 1.5, "unit": "µs"},
            "plateau_nm": {"value": 21.5, "sd": 0.2, "unit": "N·m"},
        }}  # fmt: skip
        self.add("participant", code, {"code": code, "side": "left", "muscle": "biceps"}, at=at)
        self.add("recording", f"r-{name}", {
            "id": f"r-{name}", "participant": code, "test_id": f"t-{name}", "origin": "rig", "created_utc": at,
            "file_sha256": sha256(data),
        }, data, at)  # fmt: skip
        self.add("model", f"m-{name}", {
            "id": f"m-{name}", "participant": code, "recording_id": f"r-{name}", "method": "maximum-likelihood",
            "effects": more.get("effects", ["fatigue"]), "fit": fit, "created_utc": at,
        }, model, at)  # fmt: skip
        self.add("test", f"t-{name}", {
            "id": f"t-{name}", "participant": code, "kind": "pre-session", "state": "completed", "reason": "",
            "recording_id": f"r-{name}", "model_id": f"m-{name}", "requested_utc": at,
            "plan": {"profile": {"current_ma": 40.0}},
        }, at=at)  # fmt: skip
        self.add("decision", str(len(self.items)), {
            "model_id": f"m-{name}", "participant": code, "approved": True, "by": "Ada", "at_utc": at,
        }, at=at)  # fmt: skip
        return data

    def hello(self, utc: str, **more: Any) -> dict[str, Any]:
        """A greeting."""
        last = self.items[-1]
        told = {"chain": self.chain, "seq": last["seq"], "hash": last["hash"], "version": "0.1.0", "utc": utc}
        told |= {"disk_free_bytes": 10**11, "disk_total_bytes": 10**12, "state": "ready", "reason": None, "damaged": []}
        return told | {"waiting_items": 0, "waiting_files": 0} | more

    def batch(self, first: int = 1, last: int | None = None) -> dict[str, Any]:
        """Items by their numbers."""
        return {"chain": self.chain, "items": self.items[first - 1 : last]}

    def push(self, rig: httpx.Client) -> None:
        """Everything, as a rig does it."""
        answer = rig.post("/v1/rig/items", json=self.batch())
        assert answer.status_code == 200, answer.text
        for lacking in rig.get("/v1/rig/files").json()["files"]:
            data, have = self.files[lacking["sha256"]], lacking["have_bytes"]
            place = f"/v1/rig/files/{lacking['sha256']}"
            answer = rig.put(f"{place}?offset={have}", content=data[have:])
            if answer.status_code == 409:
                have = answer.json()["have_bytes"]
                answer = rig.put(f"{place}?offset={have}", content=data[have:])
            assert answer.status_code == 200 and answer.json() == {"have_bytes": len(data), "whole": True}, answer.text

"""Warnings in words: what was found, and what to do."""

from __future__ import annotations

from typing import Any

from api import language
from api.language import _, lazy

TITLES: dict[str, Any] = {
    "restored": lazy("The rig was restored from a backup"),
    "forked": lazy("The rig's chain has forked"),
    "damaged-at-rig": lazy("A file at the rig differs from its hash"),
    "damaged": lazy("A file of the centre differs from its hash"),
    "changed": lazy("A recording was told twice, with another file"),
    "unreadable": lazy("Something that the rig told cannot be read"),
    "too-long": lazy("A file is too long to be taken"),
    "audit": lazy("The rig's audit trail has changed"),
    "clock": lazy("The rig's clock is off"),
    "disk": lazy("The rig's disk is nearly full"),
    "unseen": lazy("The rig has not been seen for a day"),
    "bucket": lazy("The centre's bucket cannot be used"),
}


def title(warning: dict[str, Any]) -> str:
    """What was found."""
    return str(TITLES.get(warning["kind"], warning["kind"]))


def advice(warning: dict[str, Any]) -> str:
    """What it means, and what to do."""
    detail, subject = warning["detail"], str(warning["subject"])
    known = {
        "restored": lambda: _restored(detail.get("seq")),
        "forked": lambda: _("Two databases push with one key, or one was changed by hand. Nothing was overwritten. See that only one rig has this key."),
        "damaged-at-rig": lambda: _("%(file)s: it was changed after it was sealed, and is not taken. Look for a copy in the rig's backup.", file=subject[:64]),
        "damaged": lambda: _("%(file)s: it is not handed out. The rigs are asked for it again; else restore it from the bucket's backup.", file=f"{subject[:12]}…"),
        "changed": lambda: _("Recording %(id)s: the first file is kept. Compare both at the rig.", id=subject[:64]),
        "unreadable": lambda: _("It is kept as it came, and shown nowhere. Is the rig's stimrig older or newer than the centre's?"),
        "too-long": lambda: _("It has %(size)s MB. It stays at the rig. The longest that is taken is set by STIMRIG_CENTRE_MAX_FILE_MB.", size=_number(detail.get("megabytes"))),
        "audit": lambda: _("Its newest entry has another hash than before. Compare the rig's database with a backup."),
        "clock": lambda: _clock(detail.get("difference_s")),
        "disk": lambda: _("%(free)s GB are free. When it is full, no test can be recorded.", free=_number(detail.get("free_gb"))),
        "unseen": lambda: _("Last on %(when)s. Its work goes on without the centre. See whether it is switched on and has a network.", when=_when(detail.get("since_utc"))),
        "bucket": lambda: _("%(words)s. Files wait at the rigs and in the data folder; nothing is lost.", words=str(detail.get("words") or "")[:300]),
    }  # fmt: skip
    return known[warning["kind"]]() if warning["kind"] in known else ""


def _restored(seq: Any) -> str:
    if isinstance(seq, int):
        return _(
            "It knows its chain up to item %(seq)s only. What the centre has beyond that is kept; the rig may lack it.",
            seq=seq,
        )
    return _("It has begun a new chain without the one before. What the centre has is kept; the rig may lack it.")


def _clock(difference_s: Any) -> str:
    if not isinstance(difference_s, int | float):
        return _("It tells a time that cannot be read. Set its clock (NTP).")
    if difference_s > 0:
        return _("It is %(seconds)s s ahead of the centre's. Set both by NTP.", seconds=_number(difference_s))
    return _("It is %(seconds)s s behind the centre's. Set both by NTP.", seconds=_number(-difference_s))


def _number(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "?"
    return language.localised(f"{value:.1f}")


def _when(value: Any) -> str:
    return language.when(value) if isinstance(value, str) and value else "?"

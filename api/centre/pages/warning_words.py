"""Warnings in words: what was found, and what to do."""

from __future__ import annotations

from typing import Any

from stimrig.api import language
from stimrig.api.language import lazy

TITLES: dict[str, Any] = {
    "restored": lazy("The rig was restored from a backup"),
    "forked": lazy("The rig's chain has forked"),
    "damaged-at-rig": lazy("A file at the rig differs from its hash"),
    "damaged": lazy("A file of the centre differs from its hash"),
    "changed": lazy("A recording or model was told twice, with another file"),
    "unreadable": lazy("Something that the rig told cannot be read"),
    "too-long": lazy("A file is too long to be taken"),
    "audit": lazy("The rig's audit trail has changed"),
    "clock": lazy("The rig's clock is off"),
    "disk": lazy("The rig's disk is nearly full"),
    "unseen": lazy("The rig has not been seen for a day"),
    "bucket": lazy("The centre's bucket cannot be used"),
}
ADVICE: dict[str, Any] = {
    "restored": lazy(
        "It knows its chain up to item {seq} only. What the centre has beyond that is kept; the rig may lack it."
    ),
    "anew": lazy("It has begun a new chain without the one before. What the centre has is kept; the rig may lack it."),
    "forked": lazy(
        "Two databases push with one key, or one was changed by hand. Nothing was overwritten. See that only one rig "
        "has this key."
    ),
    "damaged-at-rig": lazy(
        "{subject} was changed after it was sealed, and is not taken. Look for a copy in the rig's backup."
    ),
    "damaged": lazy(
        "{short} is not handed out. Its rigs are asked for it again; else restore it from the bucket's backup."
    ),
    "changed": lazy("{subject}: the first file is kept. Compare both at the rig."),
    "unreadable": lazy(
        "It is kept as it came, and shown nowhere. Is the rig's stimrig older or newer than the centre's?"
    ),
    "too-long": lazy(
        "It has {megabytes} MB, and stays at the rig. The longest that is taken is set by STIMRIG_CENTRE_MAX_FILE_MB."
    ),
    "audit": lazy(
        "Entry {seq} is not the one that was told before. Verify the trail at the rig, and compare with a backup."
    ),
    "ahead": lazy("It is {seconds} s ahead of the centre's. Set both by NTP."),
    "behind": lazy("It is {seconds} s behind the centre's. Set both by NTP."),
    "no-time": lazy("It tells a time that cannot be read. Set its clock by NTP."),
    "disk": lazy("{free_gb} GB are free. When it is full, no test can be recorded."),
    "unseen": lazy(
        "Last on {when}. Its work goes on without the centre. See whether it is switched on and has a network."
    ),
    "bucket": lazy("{words}. Files wait at the rigs and in the data folder; nothing is lost."),
}


def title(warning: dict[str, Any]) -> str:
    """What was found."""
    return str(TITLES.get(warning["kind"], warning["kind"]))


def advice(warning: dict[str, Any]) -> str:
    """What it means, and what to do."""
    detail, subject = warning["detail"], str(warning["subject"])
    words = ADVICE.get(_case(warning["kind"], detail))
    if words is None:
        return ""
    return str(words).format(
        subject=subject[:80], short=f"{subject[:12]}…", seq=detail.get("seq"),
        megabytes=_number(detail.get("megabytes")), free_gb=_number(detail.get("free_gb")),
        seconds=_number(detail.get("difference_s")), when=_when(detail.get("since_utc")),
        words=str(detail.get("words") or "")[:300],
    )  # fmt: skip


def _case(kind: str, detail: dict[str, Any]) -> str:
    """Which advice: some kinds have more than one."""
    if kind == "restored" and not isinstance(detail.get("seq"), int):
        return "anew"
    if kind == "clock":
        off_s = detail.get("difference_s")
        return "no-time" if not isinstance(off_s, int | float) else "ahead" if off_s > 0 else "behind"
    return kind


def _number(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "?"
    return language.localised(f"{abs(value):.1f}")


def _when(value: Any) -> str:
    return language.when(value) if isinstance(value, str) and value else "?"

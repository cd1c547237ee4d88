"""What `stimrig cohort` tells people: of a run, and of two runs compared."""

from __future__ import annotations

from typing import Any

from api.cli.terminal import table

MOST_ROWS = 40
"""Changed records that are shown; --json gives all."""


def run_lines(found: dict[str, Any]) -> list[str]:
    """What a person is told of a run."""
    lines = [
        f"records        {found['records']}: {found['ok']} with a result, {found['errors']} without "
        "(column `error` says why)",
        f"this run       {found['computed']} computed, {found['done_before']} done before, {found['took_s']:g} s",
    ]
    if found["left_out"]:
        lines.append(f"left out       {found['left_out']} that --select does not mean")
    if found["copies"]:
        lines.append(f"copies         {found['copies']} files with the content of another: counted once")
    if not found["records"] + found["left_out"]:
        lines.append("Nothing was found. A folder is searched for .h5, .hdf5, .csv, .tsv, .txt and .mat files.")
    return [*lines, f"written to     {found['output']}"]


def changed_lines(found: dict[str, Any]) -> list[str]:
    """A comparison for people."""
    old, new, limits = found["old"], found["new"], found["tolerances"]
    lines = [
        f"{old['verb']}: stimrig {old['software']} ({old['file']}) → stimrig {new['software']} ({new['file']})",
        *([f"made with other options: {found['other_options']}"] if found["other_options"] else []),
        f"{found['compared']} records in both: {found['unchanged']} unchanged, {found['changed']} changed",
        *(f"  {count:6d}  {kind}" for kind, count in found["counts"].items()),
        f"unchanged: a probability within {limits['probability']:g}, a parameter within {limits['parameter_sd']:g} sd "
        f"(without one {100 * limits['parameter_without_sd_relative']:g} %), held-out rms within "
        f"{100 * limits['held_out_rms_relative']:g} %",
    ]
    for words, key in (("old", "only_in_old"), ("new", "only_in_new")):
        if listed := found[key]:
            more = f" and {len(listed) - 10} more" if len(listed) > 10 else ""
            lines.append(f"only in {words}: {len(listed)} ({', '.join(listed[:10])}{more})")
    rows = [
        (row["record"], row["participant"] or "–", row["day"] or "–", "; ".join(row["why"]))
        for row in found["records"][:MOST_ROWS]
    ]
    lines += ["", *table(("record", "participant", "day", "why"), rows)] if rows else []
    hidden = len(found["records"]) - len(rows)
    return [*lines, *([f"and {hidden} records more (--json gives all)"] if hidden else [])]

"""Which electrode of an array: a search in which each stimulus is dear."""

from stimrig.identify.electrodes.layout import Elements, Layout, choices
from stimrig.identify.electrodes.search import Proposal, Search, Stop
from stimrig.identify.electrodes.wish import PRESETS, SPILLS, Seen, Wish

__all__ = ["PRESETS", "SPILLS", "Elements", "Layout", "Proposal", "Search", "Seen", "Stop", "Wish", "choices"]

"""Which electrode of an array: a search in which each stimulus is dear.

    search = Search(layout, PRESETS["balanced"][1], width_us=300, current_ma=14)
    while search.enough() is None:
        elements = search.next().elements
        search.add(elements, Seen(torque_nm, spill, comfort))
    search.best()

All choices are stimulated with one width and one current. What is believed of a choice (`posterior`) comes from
anatomies that fit what was seen (`anatomy`) and a Gaussian process for the rest (Rasmussen and Williams 2006); the next
one has the largest expected improvement (Jones, Schonlau and Welch 1998) of the person's utility (`wish`).

Assumed, for want of public data: the numbers of the prior (`anatomy`, `posterior`): where motor points and neighbours
lie, over which distance they are reached, how steeply they are recruited, that a pair reaches the mean of its elements;
how often a spill-over is reported wrongly; how comfort varies over the skin and from report to report; what changes
from session to session. That nothing tires and that the array stays where it is within one session.
"""

from stimrig.identify.electrodes.layout import Elements, Layout, choices
from stimrig.identify.electrodes.search import Proposal, Search, Stop
from stimrig.identify.electrodes.wish import PRESETS, SPILLS, Seen, Wish

__all__ = ["PRESETS", "SPILLS", "Elements", "Layout", "Proposal", "Search", "Seen", "Stop", "Wish", "choices"]

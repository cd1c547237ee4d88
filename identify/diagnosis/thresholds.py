"""Every threshold that decides a verdict, each with its reason and with what it was calibrated on.

Calibrated on development records alone (seeds 0 to 99 of `bench.diagnosis`); docs/diagnosis.md gives the figures on
others. Log evidence is a natural logarithm.
"""

from __future__ import annotations

FIRST_MARGIN = 4.5
"""Log evidence that the first effect must gain."""
NEXT_MARGIN = 10.0
"""Log evidence that a further effect must gain."""
PATCH = 0.12
"""And in proportion to what the first gained."""
KINDRED = 0.25
"""In proportion, where it resembles the first or both change the dynamics: one in an imperfect form looks like both."""
SEEN_APART = 0.03
"""In proportion, where something else bears it out: rests for a drift of zero, a gain without a law for a slow gain."""
BORNE_OUT = 0.4
"""Share of a slow gain's evidence that a gain without a law must find, too."""
PATCHER = 0.4
"""Of those that cannot be foreseen, and mend anything, more is asked for."""
AFTER_LAWS = 0.92
"""What evidence counts for efforts: of two that explain the same a law is believed, for it can be wrong elsewhere."""
AT_WORK_ONLY = 0.85
"""What evidence counts for efforts of which the rests show nothing: they'd be the first to keep to the stimulation."""
ONLY_AT_WORK = 0.85
"""Probability at most of efforts of which the rests show nothing: it may be something that the stimulation does."""
SEEN_AT_REST = 0.15
"""Least share of an effort's torque, rests against work, that counts as seen at rest."""
DYNAMIC = {"speed", "branch", "delay", "filter"}
"""Stages that change how quickly torque follows."""
SLOWEST = 0.97
"""Correlation of neighbours above which slow noise may as well be a drift."""
TEMPERATURE = 2.0
"""Spread, in log evidence, that the best form of a rival may lose by chance."""
RELATIVE = 0.03
"""And in proportion to the gain: a form close to the truth explains most, not all."""
LEAST_EXPLAINED = 0.68
"""Share of the explicable log-likelihood below which the rest counts as structure of another kind."""
LEAST_BY_EFFORTS = 0.8
"""The same where efforts are named first: they mend anything a little."""
LEAST_BY_BAND = 0.94
"""Share of the power that a tremor must take, where work and rest differ beside it."""
MANY = 4
"""Efforts, none of them at rest, that are more likely something the stimulation does."""
EVERYWHERE = 0.33
"""Share of the test that efforts last from which they are something that is always there."""
APART_S = 1.2
"""Between the middles of two bumps that are two efforts."""
UNSTEADY = 60.0
"""Log-likelihood by which work and rest must differ beside a tremor for it to be something else."""
STRUCTURE = 12.0
"""Log-likelihood by which work and rest must differ for structure to be left."""
LAPSE = 0.04
"""Probability kept for what no form of the library foresees."""
NAMELESS = 8.0
"""Log evidence by which a gain without a law must beat the best effect."""
EXPLAINED_BY_LAWS = 0.9
"""Share that effects together must explain for a gain without a law not to count."""
UNSEEN_RATIO = 2.5
"""Error on rows not seen over what is allowed there, above which structure may be left."""
UNSEEN_SHARE = 0.5
"""And in proportion to what the plain structure leaves there: a law close to the truth takes most, not all."""
UNSEEN_RISE = 1.1
"""Rise of the error on rows not seen that speaks against an effect, and ends improving."""
DOUBTED = 0.45
"""Probability at most of what something speaks against."""
HELD = 0.3
"""Share of repeated samples that no noisy converter gives."""
COUNTS = 2.5
"""Counts by which readings change from one to the next, at the median, from which a repeat is none of the counting."""
QUIET = 0.025
"""Share of the largest torque below which the muscle counts as resting."""
CLOSE = 0.8
"""Share of the best one's gain from which an effect that resembles it is named beside it."""
RIVAL = 0.04
"""Probability from which an effect is named as one that the record can't tell from the best."""
NEAR = 0.02
"""Distance to a width that was fitted, as a share of the largest, beyond which the curve is a guess."""
FORM = 0.01
"""Error, as a share of the largest torque, that a curve of few knots may leave on rows not seen: nulls do."""
FORM_OF_EFFECTS = 0.003
"""The same where an effect is named: its law must hold on rows not seen, too."""
LEAST_UNSEEN_ROWS = 40
"""Intervals, a second at 40 pulses/s: of fewer nothing is said."""

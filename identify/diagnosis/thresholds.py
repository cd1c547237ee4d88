"""The thresholds of the search and of its verdict, with the reason for each.

All were calibrated on development records only (seeds 0 to 99 of `bench.diagnosis`); docs/diagnosis.md gives the
results on other records. Log evidence is a natural logarithm. A "sporadic" effect comes and goes by no
law, as efforts and tremor do. The muscle is "at work" in the intervals in which it pulls, and "at rest" in all others.
"""

from __future__ import annotations

FIRST_MARGIN = 4.5
"""Log evidence that the first effect must gain."""
NEXT_MARGIN = 10.0
"""Log evidence that every further effect must gain, at least, and log-likelihood by which work and rest must differ for
structure to be left."""
BETTER = 1.0
"""Standard errors by which the error on left-out blocks must fall with an effect, and by which it may rise with one
that cannot be foreseen: such an effect need not predict, but it must not spoil what the muscle does."""
BETTER_IF_DOUBTFUL = 2.0
"""The same for a first effect that gains less log evidence than a further one must, and for a free effect beside which
nothing is named."""
BETTER_THAN_ALIKE = 3.0
"""The same if it resembles an effect that is there, both change the dynamics, or that one is free: one effect in an
inexact form looks like two."""
FREE_FALL = 0.2
"""Logarithm by which that error must fall with a free effect, too: it is chosen among many."""
TERM_MARGIN = 3.0
"""Log evidence that a further term must gain."""
SUPERFLUOUS = 1.5
"""Standard errors of the left-out error up to which it may rise without a term that later ones made superfluous."""
NEAR = 0.1
"""Logarithm of the left-out error by which a chain of fewer terms may predict worse than the best one."""
NAMES_SHARE = 0.5
"""Share of the log evidence gained by terms alone that names must gain where something is left beside them."""
UNSURE = 0.85
"""Weight of the evidence for efforts: where a law explains as much, the law is preferred, since it can be tested."""
SHARE_AT_REST = 0.15
"""An effort is seen at rest if its torque there is at least this share of its torque at work."""
SHORTEST_WAVE_S = 0.3
"""Time, s, in which a tremor dies away at the soonest; a limb on a spring swings for less after a pulse."""
TEMPERATURE = 2.0
"""Log evidence that the best form of a rival may lose by chance."""
RELATIVE = 0.03
"""The same as a share of the gain: a form close to the true one explains most of the error, not all."""
LEAST_EXPLAINED = 0.75
"""Share of the explainable log-likelihood that effects must explain; otherwise another kind of structure is left."""
LEAST_EXPLAINED_BY_BAND = 0.9
"""Share of the residual's power that a tremor must explain, if work and rest differ beside it."""
LEAST_RIVAL = 0.04
"""Share of probability in its round below which a rival is not named."""
HELD_OUT_RATIO = 2.5
"""Error on held-out pulses, divided by what is allowed there, above which structure may be left."""
HELD_OUT_SHARE = 0.5
"""The same as a share of the plain structure's error there: a law close to the true one takes most of it, not all."""
QUIET = 0.025
"""Share of the largest torque below which the muscle counts as resting."""
CLOSE = 0.8
"""An effect that resembles the best one is named beside it from this share of its gain."""
FORM_ERROR = 0.01
"""Error, as a share of the largest torque, that a curve of few knots may leave on held-out pulses."""
LEAST_HELD_OUT_ROWS = 40
"""With fewer held-out pulse intervals (1 s at 40 pulses/s) nothing is concluded from them."""
NAMED_BUT = 1.3
"""Error from which free effects are tried beside named ones, and a further test is planned: on held-out pulses divided
by what is allowed there, or on the fitted rows by the white noise alone."""

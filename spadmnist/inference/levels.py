"""Levels of decisions: what each decides, its unit, and its price in false alarms.

In this package a constant that names no source and no measurement is a rule of thumb. Right models, open cases and
sealed ones (`scripts/frozen.py`, `scripts/challenge.py`) say whether all of them together are right.
"""

from __future__ import annotations

# probability that the whole comparison fails a model that is right, and the largest p-value of a step where checks
# fail; a convention
FALSE_ALARM = 0.01
# shares of the allowed false alarms, by kind of check: the light, and the total of each capture. One each, lest a power
# meter that is off drowns among a hundred statistics; how large they are is a rule of thumb
SHARES = {"light": 0.25, "rate": 0.25}
SHARE_OF_TOTALS = sum(SHARES.values())  # of the allowed false alarms: the light and the totals together
SHARE_OF_STATISTICS = 1 - SHARE_OF_TOTALS  # of the allowed false alarms: all statistics together, the rest
# p-value of a check that fails clearly. Others are decided by the fit of all numbers and by more replicates, and the
# noise of a fit to first order fails none so clearly. A rule of thumb
CLEARLY = 1e-6
# in chi square: the least evidence for a step that is accepted; a rule of thumb
LEAST_EVIDENCE = 12.0
# of twice the log-likelihood, at the ends of a 95 % interval: that quantile of chi square with one degree of freedom
FALL_95 = 3.84
HALF_95 = 1.96  # standard deviations: half of a 95 % interval of a normal law
# in chi square: the optimism of one fitted parameter (Akaike, IEEE Trans. Autom. Control 19 (1974) 716); evidence is
# less by so much
OPTIMISM_OF_A_PARAMETER = 2.0
LEAST_P = 1e-300  # a p-value is never 0, so that it has a logarithm and a normal score: near the least of a double
# in chi square: the least fall for each further free parameter, by which explanations of several numbers compare; 3
# standard deviations of one number, a rule of thumb
COST_OF_A_PARAMETER = 9.0
# in chi square: the least fall of the squares of a candidate that is looked at more closely; 5 standard deviations of
# one number, a rule of thumb
PROMISING = 25.0
# of the expected score of a step: its own cells carry it, and by them it is judged; `formats` has it. A rule of thumb
OWN_CELLS = 0.9
# of the excess misfit in its own cells: the least fall that a step explains; `formats` has it. Two failing checks are
# one deviation if one has so much of the other's excess. A rule of thumb
LEAST_FALL = 0.7

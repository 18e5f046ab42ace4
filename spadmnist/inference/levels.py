"""Levels of decisions: what each decides, its unit, and its price in false alarms."""

from __future__ import annotations

FALSE_ALARM = 0.01  # probability that the whole comparison fails a model that is right
SHARES = {"light": 0.25, "rate": 0.25}  # shares of the allowed false alarms, by kind of check
SHARE_OF_TOTALS = sum(SHARES.values())  # of the allowed false alarms: the light and the totals together
SHARE_OF_STATISTICS = 1 - SHARE_OF_TOTALS  # of the allowed false alarms: all statistics together
LEAST_GAIN = 12.0  # in chi square: the least evidence for a step that is accepted
COST_OF_A_NUMBER = 9.0  # in chi square: the least gain of each further free parameter
PROMISING = 25.0  # in chi square: the least fall of the squares of a candidate that is looked at more closely
OWN_CELLS = 0.9  # of the expected score of a step: its own cells carry it; `formats` has it
LEAST_FALL = 0.7  # of the excess misfit in its own cells: the least fall that a step explains; `formats` has it

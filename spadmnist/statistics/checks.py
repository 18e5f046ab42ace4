"""Checks of a comparison that are no statistic of one recording: light levels, totals, ratios between captures.

`spadmnist.inference.comparison` makes them; here stands what each is, under the name that it has in an answer.
"""

from __future__ import annotations

from typing import ClassVar

from ..plugins import Plugin, Registry
from ..recording import MODALITIES

__all__ = ["Check"]


class Check(Plugin, abstract=True):
    """Base of every such check: its name, and its docstring."""

    registry: ClassVar[Registry] = Registry("check of a comparison", verb="statistics", from_files=False)
    modalities: ClassVar[tuple[str, ...]] = tuple(MODALITIES)
    unit: ClassVar[str] = "1"
    flat: ClassVar[bool] = False


class Light(Check):
    """The light level of all lit captures together, against what the measurement states.

    The light factor f of a capture is the light, relative to the stated level, at which the model's mean total is the
    measured total. The factor of all is the mean of their logarithms, weighted by 1 / s^2; s is the standard error of
    log f. A capture without a stated level has no part in it.
    Law: normal. z = mean log f / sqrt(relative_uncertainty^2 + standard error^2), p = 2 (1 - Phi(|z|)).
    Fails: where p is too small for a right model by Holm's correction; this check has 25 % of the false alarms of a
    comparison, which fails 1 % of right models.
    Shows: a wrong power meter, filter or exposure of all lit captures, a wrong PDP or fill factor.
    Source: weighted mean, Cowan, Statistical Data Analysis, ch. 7; Holm, Scand. J. Statist. 6, 65 (1979).
    """


class Rate(Check):
    """The detections of the whole capture, against the model at the light level of the other captures.

    Lit: the light factor f of the capture (see `light`) against f0, the weighted mean of the other lit captures and of
    the stated level. Dark, or with so little light that hardly a detection comes from it: the total against the
    model's total.
    Law: normal. Lit: z = (log f - log f0) / sqrt(s^2 + s0^2), with s and s0 the standard errors; s includes the
    capture's own_uncertainty. Dark: z is the normal score of the total. p = 2 (1 - Phi(|z|)).
    Fails: where p is too small for a right model by Holm's correction; these checks of all captures together have 25 %
    of the false alarms of a comparison, which fails 1 % of right models.
    Shows: another response to light than the model's (dead time, saturation); another dark count rate; a wrong light
    level or exposure of one capture. What all lit captures have in common is in `light`.
    Source: linearity and dark signal, EMVA standard 1288; Holm, Scand. J. Statist. 6, 65 (1979).
    """


class WavelengthRatio(Check):
    """The ratio of each pixel's detections at two neighbouring wavelengths, against the model's ratio.

    Of each wavelength the capture with the most detections is taken. A pixel's PDP and fill factor, which the map of
    each capture has, drop out if they are the same at both wavelengths.
    Law: normal. For each pixel z = (d2 - d1) / sqrt(w1^2 + w2^2), with d the relative deviation of the pixel from the
    model and w its spread under the model. p is twice the smaller one of two: of the sum of z^2 (chi square), and of
    the largest |z| times the number of pixels.
    Fails: where p is too small for a right model by Holm's correction; it is one of the statistics, which together
    have 50 % of the false alarms of a comparison, which fails 1 % of right models.
    Shows: a PDP whose dependence on the wavelength differs between pixels.
    Source: photon response non-uniformity, EMVA standard 1288; Holm, Scand. J. Statist. 6, 65 (1979).
    """

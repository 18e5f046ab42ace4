"""Timing jitter."""

from __future__ import annotations

import numpy as np

from .. import kernels
from ..events import Events
from ..streams import Draws
from . import Effect, Mimic, parameter


class Jitter(Effect, stage="timing"):
    """A time stamp scatters about its avalanche: a normal core and an exponential tail.

    time += Normal(0, sigma) + Bernoulli(tail_weight) * Exp(tail), drawn for each stamp before it is digitised. The mean
    delay of the core is part of the clock. A stamp stays inside its exposure (STR: its frame). The number of detections
    does not change, and both rules are the same. In steady light jitter only blurs the edge of the dead time and peaks
    at short delays.
    Source: Suonsivu et al., Sec. 3 (normal core, exponential tail from carriers that diffuse in; Table 1: 20-500 ps),
    after Sun et al. 2019. Alg. 1 leaves it out. Tails of 5-20 % and 0.1-1 ns are experience, no published number.
    """

    by_pixel = True
    counted = True
    moves = ("edge",)
    mimic = Mimic("a dead time that differs from event to event", "pixel", "a pulsed source")

    sigma = parameter(
        50e-12,
        "s",
        "standard deviation of the normal core",
        symbol="sigma_j",
        bounds=(0, None),
        off=0.0,
        search=(5e-12, 5e-9),
    )
    tail_weight = parameter(
        0.0,
        "",
        "share of the events in the tail",
        symbol="w_j",
        bounds=(0, 1),
        off=0.0,
        search=(0.01, 0.5),
    )
    tail = parameter(
        200e-12,
        "s",
        "mean of the exponential tail",
        symbol="tau_j",
        bounds=(0, None),
        search=(50e-12, 5e-9),
        needs="tail_weight",
    )

    def apply(self, events: Events, rng: Draws) -> Events:
        if self.sigma == 0 and self.tail_weight == 0:
            return events
        law = self.sigma, float(self.tail_weight), self.tail
        return events.moved(delayed(events.times, events.image_offsets, rng.images, rng.key, rng.before, *law))


_BATCH = 128  # events at a time: what is in between stays in the cache
_CENTRE = 0.425


@kernels.inline
def _ratio(x, p0, p1, p2, p3, p4, p5, p6, p7, q1, q2, q3, q4, q5, q6, q7):  # type: ignore[no-untyped-def]
    above = ((((((p7 * x + p6) * x + p5) * x + p4) * x + p3) * x + p2) * x + p1) * x + p0
    return above / (((((((q7 * x + q6) * x + q5) * x + q4) * x + q3) * x + q2) * x + q1) * x + 1.0)


# fmt: off
@kernels.inline
def _normal_centre(q):  # type: ignore[no-untyped-def]
    """Standard normal whose chance of being less is 0.5 + q, abs(q) <= 0.425."""
    return q * _ratio(
        0.180625 - q * q,
        3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
        4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3,
        4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3, 2.1213794301586595867e4,
        3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3,
    )


@kernels.inline
def _normal_edge(u):  # type: ignore[no-untyped-def]
    """Standard normal whose chance of being less is u, for other u."""
    r = np.sqrt(-kernels._log(min(u, 1.0 - u)))
    if r <= 5.0:
        z = _ratio(
            r - 1.6,
            1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
            1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4,
            2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1, 1.48103976427480074590e-1,
            1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9,
        )
    else:
        z = _ratio(
            r - 5.0,
            6.65790464350110377720e0, 5.46378491116411436990e0, 1.78482653991729133580e0, 2.96560571828504891230e-1,
            2.65321895265761230930e-2, 1.24266094738807843860e-3, 2.71155556874348757815e-5, 2.01033439929228813265e-7,
            5.99832206555887937690e-1, 1.36929880922735805310e-1, 1.48753612908506148525e-2, 7.86869131145613259100e-4,
            1.84631831751005468180e-5, 1.42151175831644588870e-7, 2.04426310338993978564e-15,
        )
    return z if u > 0.5 else -z
# fmt: on


@kernels.jit
def normals(chance):  # type: ignore[no-untyped-def]
    """Standard normals from numbers in (0, 1), by inversion (Wichura, AS 241); the same bits on every machine."""
    out = np.empty(chance.size)
    for i in range(chance.size):
        q = chance[i] - 0.5
        out[i] = _normal_centre(q) if abs(q) <= _CENTRE else _normal_edge(chance[i])
    return out


@kernels.jit
def delayed(times, image_offsets, images, key, before, sigma, weight, tail):  # type: ignore[no-untyped-def]
    """The times of an image's j-th event, later by block j of the stream: the first word's normal, the second's tail.

    The second word decides both whether there is a tail and, where there is, how long: u / weight is uniform then.
    before: events of the image that come before these.
    """
    out = np.empty(times.size)
    core = np.empty(_BATCH)
    late = np.empty(_BATCH)
    for i in range(images.size):
        stop = image_offsets[i + 1] - image_offsets[i]
        for first in range(0, stop, _BATCH):
            start = np.uint64(image_offsets[i] + first)
            count = np.uint64(min(stop - first, _BATCH))
            for j in range(count):
                a, b = kernels.philox(np.uint64(before + first) + j, images[i], key[0], key[1], key[2])
                core[j] = kernels.uniform(a)
                late[j] = kernels.uniform(b)
            # the centre's formula for all, without a branch, then the few others once more
            for j in range(count):
                out[start + j] = times[start + j] + sigma * _normal_centre(core[j] - 0.5)
            for j in range(count):
                if abs(core[j] - 0.5) > _CENTRE:
                    out[start + j] = times[start + j] + sigma * _normal_edge(core[j])
            if weight > 0.0:
                for j in range(count):
                    if late[j] < weight:
                        out[start + j] -= tail * kernels._log(late[j] / weight)
    return out

"""What the camera of the tutorial hides. Read docs/start/loop.md first."""

import numpy as np

from spadmnist import Effect, parameter
from spadmnist.events import Children


class Secret(Effect, stage="correlated"):
    """Some detections echo in their own pixel, always equally long after the dead time: a reflection.

    Source: this tutorial.
    """

    share = parameter(0.01, "", "share of the detections that echo", bounds=(0, 1), off=0.0, search=(1e-4, 0.1))
    delay = parameter(100e-9, "s", "how long after the dead time", bounds=(0, None), search=(20e-9, 1e-6))

    def spawn(self, events, rng):
        parent = np.flatnonzero(rng.random(len(events)) < self.share)
        return Children(parent, np.full(len(parent), self.delay))

    def expected_rate(self, rate, conditions):
        """r = rate (1 + share)."""
        return rate * (1 + self.share)

"""Where random numbers come from: streams named by what they are for, never by a place in a list.

One seed gives the same numbers for any number of workers, any order and any interruption, and any image can be made
alone: a draw is a function of (seed, light level's value, split, image, what it is for).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np

BLOCK = 32  # images that share one numpy generator, for effects that do not count their draws


@dataclass(frozen=True)
class Streams:
    """The random streams of some images at one light level.

    seed: the config's; level: text that identifies the light level's value; split: "train" or "test";
    images: (n,) uint64, the images' indices within the split.
    """

    seed: int
    level: str
    split: str
    images: np.ndarray
    _keys: dict[str, np.ndarray] = field(default_factory=dict, repr=False, compare=False)
    _reached: dict[str, tuple[int, np.ndarray]] = field(default_factory=dict, repr=False, compare=False)

    def _digest(self, name: str) -> bytes:
        return hashlib.sha256(f"{self.seed}/{self.level}/{self.split}/{name}".encode()).digest()

    def key(self, name: str) -> np.ndarray:
        """(3,) uint64, each below 2^32: key and stream word for the counter-based kernels."""
        known = self._keys.get(name)
        if known is None:
            known = np.frombuffer(self._digest(name)[:12], "<u4").astype(np.uint64)
            self._keys[name] = known
        return known

    def of(self, images: np.ndarray) -> Streams:
        """The same streams for other images, from their beginning."""
        return Streams(self.seed, self.level, self.split, images, self._keys)

    def draws(self, name: str, events: int) -> Draws:
        """What a stream gives for so many events, which come behind those that it was asked for before.

        Only an image by itself may be asked for in several calls.
        """
        before, place = self._reached.get(name) or (0, beginning(len(self.images)))
        assert not before or len(self.images) == 1, "an image that is drawn in several calls is drawn by itself"
        self._reached[name] = before + events, place
        return Draws(self.key(name), self.images, before, place)

    def generator(self, name: str) -> np.random.Generator:
        """A numpy generator of its own for this block of images.

        The images are one whole block (`BLOCK` of them, or the last ones of the split).
        """
        first = int(self.images[0])
        assert first % BLOCK == 0 and len(self.images) <= BLOCK, "generators belong to whole blocks of images"
        words = np.frombuffer(self._digest(f"{name}/block {first // BLOCK}"), "<u4")
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(words.tolist())))


@dataclass(frozen=True)
class Draws:
    """What an effect with `counted = True` gets as `rng`: the key of its own stream and the images' numbers.

    A large image is simulated some pixels at a time, in the order of the pixels, and its draws are the same however it
    is cut. So a draw belongs to a pixel, by its number on the chip, or to an event by its place in its image, which is
    `before` for the first one of a call; or it belongs to a process that runs along the events, and then its place is
    noted in `place`, from which the next call goes on.

    before: events of the image in the calls before, 0 where whole images are simulated (of which there may be many).
    place: (images, 3) float64, `beginning` in an image's first call, to be filled by the hook as it needs.
    """

    key: np.ndarray
    images: np.ndarray
    before: int = 0
    place: np.ndarray = field(default_factory=lambda: np.empty((0, 3)), repr=False, compare=False)

    def __post_init__(self) -> None:
        if len(self.place) != len(self.images):
            object.__setattr__(self, "place", beginning(len(self.images)))


def beginning(images: int) -> np.ndarray:
    """(images, 3) float64: that no draw of a stream was taken yet. Every number is negative."""
    return np.full((images, 3), -1.0)

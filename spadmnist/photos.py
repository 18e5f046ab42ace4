"""Pictures of any size as images of one: to linear light, over black where they are transparent, grey, to a size.

The light of a pixel is proportional to its grey level; a picture's values are not, unless a scientific camera took it.
sRGB, which nearly all pictures are in, is taken back to light before pixels are mixed: of values the mean is not light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear red, green and blue: Rec. 709, which sRGB uses
_DEEP = 65535  # white of linear light from sRGB: 8 bits would make one black of its 34 darkest levels


@dataclass(frozen=True)
class Making:
    """How a picture becomes an image; as it is, where nothing is said.

    size: (rows, columns) that it is brought to; fit: how, where its sides are in another proportion: crop, pad with
    black, or stretch; grey: one channel of the luminance; gamma: what its values are, `linear` light or `srgb`.
    """

    size: tuple[int, int] | None = None
    fit: str = "crop"
    grey: bool = False
    gamma: str = "linear"

    def white(self, given: float) -> float:
        """The grey level of white of the image that is made; given: that of the picture."""
        return float(_DEEP) if self.gamma == "srgb" else given

    def image(self, pixels: np.ndarray, alpha: np.ndarray | None, white: float) -> np.ndarray:
        """The image of a picture: (rows, columns) or (3, rows, columns), of the picture's type, from sRGB uint16.

        pixels: of the picture, unsigned integers up to `white`; alpha: (rows, columns) uint8, 0 where it is
        transparent, or None.
        """
        mixed = self.grey and pixels.ndim == 3
        if alpha is None and not mixed and self.gamma == "linear" and self.size in (None, pixels.shape[-2:]):
            return pixels
        levels = np.arange(int(pixels.max()) + 1, dtype=np.float32) / np.float32(white)
        light = srgb_to_light(levels) if self.gamma == "srgb" else levels
        planes = np.stack([self._plane(light[plane], alpha) for plane in pixels.reshape(-1, *pixels.shape[-2:])])
        if mixed:
            planes = np.tensordot(_LUMINANCE, planes, 1)[None]
        kind = np.uint16 if self.gamma == "srgb" else pixels.dtype
        made = np.rint(planes * np.float32(self.white(white))).astype(kind)
        return made[0] if mixed or pixels.ndim == 2 else made

    def _plane(self, light: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:
        """One channel of light at the size that is wanted."""
        from PIL import Image, ImageOps

        if alpha is not None:
            light = light * (alpha / np.float32(255))
        if self.size is None or self.size == light.shape:
            return light
        picture: Any = Image.fromarray(light)
        # it means over what falls on a pixel, and its weights are never below 0: no light is invented, nor taken away
        how = Image.Resampling.BILINEAR
        if self.fit == "crop":
            return np.asarray(ImageOps.fit(picture, self.size[::-1], how))
        if self.fit == "stretch":
            return np.asarray(picture.resize(self.size[::-1], how))
        scale = min(self.size[0] / light.shape[0], self.size[1] / light.shape[1])
        rows, columns = (max(1, round(scale * n)) for n in light.shape)
        top, left = (self.size[0] - rows) // 2, (self.size[1] - columns) // 2
        padded = np.zeros(self.size, np.float32)
        padded[top : top + rows, left : left + columns] = picture.resize((columns, rows), how)
        return padded


def srgb_to_light(values: np.ndarray) -> np.ndarray:
    """Light from 0 to 1 of values from 0 to 1. Source: IEC 61966-2-1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)

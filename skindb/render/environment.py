"""Environment maps: light from all directions, as an image of distant surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.render.image import read_exr

Float = NDArray[np.floating[Any]]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec. 709


@dataclass(frozen=True)
class Environment:
    """Radiance (h, w, 3) of distant surroundings as an equirectangular image, constant
    in each texel.

    Row 0 is above the head (+y). The middle column is in front of the face (+z), and
    columns to the right of it are at the subject's left (+x).
    """

    radiance: Float

    @classmethod
    def read(cls, path: str | Path) -> Environment:
        """Read an environment from an OpenEXR file.

        Raises
        ------
        InputError
            If the file cannot be read, has no channels R, G and B, is not twice as wide
            as it is high, has values that are negative or not finite, or is zero
            everywhere.
        """
        pixels, names = read_exr(path)
        if names[:3] != ("R", "G", "B"):
            rule = "an environment must have the channels R, G and B"
            cure = "write it as an RGB image"
            raise InputError(Fault(str(path), rule, ", ".join(names), cure))
        values = pixels[..., :3].astype(np.float64)
        finite = np.isfinite(values)
        height, width = values.shape[:2]
        if width != 2 * height:
            rule = (
                "a latitude-longitude image of all directions must be twice as wide as "
                "it is high"
            )
            raise InputError(
                Fault(
                    str(path), rule, f"{width} x {height} pixels", "convert the image"
                )
            )
        if not finite.all() or values.min() < 0 or values.max() == 0:
            rule = "radiance must be finite, not negative, and not zero everywhere"
            cure = "correct the image"
            fault = (
                f"{int((~finite).sum())} values that are not finite, "
                f"{int((values < 0).sum())} negative ones"
            )
            fault = "zero everywhere" if finite.all() and not values.any() else fault
            raise InputError(Fault(str(path), rule, fault, cure))
        return cls(values)

    def along(self, direction: Float) -> Float:
        """Radiance (n, 3) from unit directions (n, 3)."""
        return np.asarray(self.radiance.reshape(-1, 3)[self._texel(direction)])

    def pdf(self, direction: Float) -> Float:
        """Probability density (n,) per steradian with which `sample` draws unit
        directions (n, 3).
        """
        texel = self._texel(direction)
        return np.asarray(self._probability[texel] / self._solid_angle[texel])

    def sample(self, draw: Float) -> Float:
        """Unit directions (n, 3) drawn in proportion to luminance, from uniform numbers
        (n, 3) in [0, 1).
        """
        place = np.searchsorted(
            self._rising, draw[:, 0] * self._rising[-1], side="right"
        )
        texel = np.minimum(place, len(self._rising) - 1)
        height, width, _ = self.radiance.shape
        row, column = np.divmod(texel, width)
        across = draw[:, 1]
        down = draw[:, 2]
        top = np.cos(np.pi * row / height)
        bottom = np.cos(np.pi * (row + 1) / height)
        cosine = top + down * (bottom - top)
        turn = 2 * np.pi * ((column + across) / width - 0.5)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
        return np.stack([sine * np.sin(turn), cosine, sine * np.cos(turn)], axis=1)

    def _texel(self, direction: Float) -> NDArray[np.int64]:
        height, width, _ = self.radiance.shape
        row = np.arccos(np.clip(direction[:, 1], -1, 1)) / np.pi * height
        column = (
            np.arctan2(direction[:, 0], direction[:, 2]) / (2 * np.pi) + 0.5
        ) * width
        row_start = np.minimum(row.astype(np.int64), height - 1) * width
        return np.asarray(row_start + np.minimum(column.astype(np.int64), width - 1))

    @cached_property
    def _solid_angle(self) -> Float:
        height, width, _ = self.radiance.shape
        edge = np.cos(np.pi * np.arange(height + 1) / height)
        return np.repeat((edge[:-1] - edge[1:]) * 2 * np.pi / width, width)

    @cached_property
    def _probability(self) -> Float:
        power = self.radiance.reshape(-1, 3) @ LUMINANCE * self._solid_angle
        return np.asarray(power / power.sum())

    @cached_property
    def _rising(self) -> Float:
        return np.cumsum(self._probability)

"""The virtual camera behind its lens: exposure, noise, saturation, quantisation, black level."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from skindb.files import private_file

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Sensor:
    """Levels are values of the 16-bit file; exposure 1 (radiance times seconds) reaches
    the white level.
    """

    black: int = 1024
    white: int = 65520
    step: int = 16  # a 12-bit converter, left-justified in 16 bits
    full_well: float = 20000.0  # electrons
    read_noise: float = 6.0  # electrons
    pattern_noise: float = 2.0  # electrons, the same in every frame of a camera
    noisy: bool = True

    @property
    def electrons_per_dn(self) -> float:
        """Electrons per value of the file."""
        return self.full_well / (self.white - self.black)

    def pattern(self, shape: tuple[int, ...], *, rng: np.random.Generator) -> Image:
        """Fixed offset of every photosite, electrons."""
        return rng.standard_normal(shape, np.float32) * np.float32(
            self.pattern_noise if self.noisy else 0.0
        )

    def expose(
        self,
        exposure: Image,
        pattern: Image,
        *,
        averaged: int = 1,
        rng: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """File values of an image of exposures; with `averaged` > 1 the mean of that
        many frames (finer steps).
        """
        electrons = exposure * np.float32(self.full_well)
        if self.noisy:
            sigma = np.sqrt(
                (np.maximum(electrons, 0) + np.float32(self.read_noise**2))
                / np.float32(averaged)
            )
            electrons = (
                electrons
                + pattern
                + sigma * rng.standard_normal(exposure.shape, np.float32)
            )
        step = self.step if averaged == 1 else 1
        value = np.float32(self.black) + electrons / np.float32(self.electrons_per_dn)
        return np.asarray(
            np.clip(np.rint(value / step) * step, 0, self.white).astype(np.uint16)
        )


def write_png(path: Path, frame: NDArray[np.uint16]) -> None:
    """Write a 16-bit RGB PNG quickly: sensor noise does not compress, so Huffman codes
    of differences are enough.
    """
    png = imagecodecs.PNG
    data = imagecodecs.png_encode(
        frame, level=1, strategy=png.STRATEGY.HUFFMAN_ONLY, filter=png.FILTER.SUB
    )
    private_file(path).write_bytes(data)

"""Flags of a pixel after its exposures were merged; radiance and samples use the same flags."""

from __future__ import annotations

import numpy as np

OK = 0
SATURATED = 1
DARK = 2
# standard deviations of read noise above black; a pixel at or below it is dark
DARK_SIGMA = np.float32(2.0)

from __future__ import annotations

import imagecodecs
import numpy as np
import pytest
from sphere import WHITE

from skindb.calibration.fibres import fibre_pixels
from skindb.format.folder import read_capture
from skindb.ingest.probe_profiles import fibre_profiles


def _spoil(probe, fibre, count, channel):
    """Put the first `count` pixels of a fibre of the first site at the white level in
    every bracket.
    """
    for e in probe.exposures:
        path = probe.frame(probe.sites[0], e)
        frame = imagecodecs.png_decode(path.read_bytes()).copy()
        rows, columns = np.divmod(
            fibre_pixels(probe, frame.shape[:2])[fibre], frame.shape[1]
        )
        frame[rows[:count], columns[:count], channel] = WHITE
        path.write_bytes(imagecodecs.png_encode(frame))


@pytest.mark.parametrize("count", [1, 12])
def test_fibre_profiles__a_partly_saturated_fibre_is_unknown(capture_folder, count):
    """One of its 36 pixels is more than 1 %: the rest of the face would be read instead
    of all of it.
    """
    probe = read_capture(capture_folder).probe
    _spoil(probe, 0, count, 0)
    profiles = fibre_profiles(probe)
    unknown = np.zeros_like(profiles.value, bool)
    unknown[0, 0, 0] = True  # other channels, fibres and sites keep their value
    np.testing.assert_array_equal(np.isnan(profiles.value), unknown)
    np.testing.assert_array_equal(np.isnan(profiles.error), unknown)


def test_fibre_profiles__a_stuck_pixel_of_a_large_fibre_does_not_count(capture_folder):
    probe = read_capture(capture_folder).probe
    probe.radius[:] = 5.75  # 104 pixels, the rim dark
    before = fibre_profiles(probe)
    _spoil(probe, 0, 1, 0)
    after = fibre_profiles(probe)
    # the pixel taken away was of the dark rim: the mean rises by its share
    assert after.value[0, 0, 0] / before.value[0, 0, 0] - 1 == pytest.approx(
        1 / 104, rel=0.1
    )

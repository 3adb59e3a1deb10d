"""Studies say which takes have surfels of another spacing."""

import numpy as np
import xarray as xr

from skindb.analysis.quantities import spacing_notes
from skindb.geometry.mesh import lattice_spacing
from skindb.schema.notes import note


def _tables(spacings):
    area = np.array([lattice_spacing(1.0) ** -2 * x**2 for x in spacings])
    counts = np.array([[100, 300]] * len(area))
    values = {
        "region_area": (("take", "region"), counts * area[:, None]),
        "region_surfels": (("take", "region"), counts),
    }
    return xr.Dataset(values, {"take": ["A", "B", "C"]})


def test_spacing_notes__name_the_finest_and_the_coarsest_take():
    """A lattice of spacing s has an area of s^2 times a constant per point."""
    said = (
        "surfels are 1.8 mm apart in B and 3.4 mm in C: ingest the takes again with "
        "--spacing 1.8"
    )
    assert spacing_notes(_tables([2.0, 1.77, 3.4])) == [note("", said)]


def test_spacing_notes__accept_scans_of_one_scanner_and_takes_without_surfels():
    assert spacing_notes(_tables([3.38, 3.5, 3.4])) == []
    empty = _tables([3.4, 1.0, 3.4])
    empty["region_surfels"][1] = 0
    assert spacing_notes(empty) == []

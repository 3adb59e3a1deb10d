"""Roughness of planted sheets, against the Fourier transform of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.analysis import region_tables
from skindb.analysis.roughness import MAX_SPACING, MIN_AREA, SIGMAS
from skindb.schema import dataset
from skindb.virtual.skin import smooth_noise

SIDE = 100.0  # mm
AMPLITUDE = 0.1  # of log R_d and of the slope
NOISE = 0.12  # relative standard error of R_d
TURN = 6.0  # degrees, standard error of normals


def _sheet(spacing, wave, *, noise=0.0, seed=0):
    """A flat sheet whose albedo and relief are waves, and the mask of its region; `wave`
    is a function of points (n, 3) and of a phase.
    """
    rng = np.random.default_rng(seed)
    edge = np.arange(0, SIDE, spacing)
    point = np.stack(np.meshgrid(edge, edge, [0.0]), axis=-1).reshape(-1, 3)
    n = len(point)
    point[:, :2] += spacing * rng.uniform(-0.3, 0.3, (n, 2))
    log = np.log(0.3) + AMPLITUDE * wave(point, 0.3)[:, None]
    colour = np.exp(log + noise * NOISE * rng.normal(size=(n, 3)))
    turn = noise * np.radians(TURN / np.sqrt(2)) * rng.normal(size=(n, 2))
    slope = AMPLITUDE * wave(point, 1.1)
    normal = np.column_stack([slope + turn[:, 0], turn[:, 1], np.ones(n)])
    fitted = dataset(
        {
            "diffuse_reflectance": colour,
            "diffuse_reflectance_error": noise * NOISE * colour,
            "shading_normal": normal / np.linalg.norm(normal, axis=1)[:, None],
            "normal_error": np.full(n, noise * TURN),
            "surfel_area": np.full(n, spacing**2),
            "surfel_position": point,
            "fit_status": np.zeros(n),
        },
        coords={"channel": ["R", "G", "B"]},
    )
    return fitted, {"face": np.ones(n, bool)}


@pytest.mark.parametrize(
    ("spacing", "noise", "tolerance"), [(1.2, 0, 0.04), (1.9, 0, 0.04), (1.5, 1, 0.08)]
)
def test_region_tables__roughness_of_waves_is_that_of_the_band(
    spacing, noise, tolerance
):
    """Four per cent are the edge of the sheet and places that are not even; noise would
    add 8 to 24 % if it were not subtracted, and is known to 2 %.
    """
    for wavelength in (12.0, 16.0, 24.0):

        def wave(point, phase, number=2 * np.pi / wavelength):
            return np.sin(number * point @ [0.6, 0.8, 0] + phase)

        table = region_tables(*_sheet(spacing, wave, noise=noise)).isel(region=0)
        narrow, wide = np.exp(-2 * np.pi**2 * SIGMAS**2 / wavelength**2)
        want = AMPLITUDE * (narrow - wide) / np.sqrt(2)
        contrast = table["region_albedo_contrast"].mean("channel")
        np.testing.assert_allclose(contrast, want, rtol=tolerance)
        np.testing.assert_allclose(table["region_normal_slope"], want, rtol=tolerance)


def test_region_tables__errors_of_roughness_are_the_scatter_of_fields():
    """40 fields give the scatter to 11 %; three times that, and as much again for patches
    that are smaller than the longest waves, is allowed.
    """
    tables = []
    for seed in range(40):
        rng = np.random.default_rng([7, seed])
        field = _sheet(
            2.0, lambda point, _, rng=rng: smooth_noise(point, 15.0, rng=rng), seed=seed
        )
        tables.append(region_tables(*field).isel(region=0))
    for name in ("region_albedo_contrast", "region_normal_slope"):
        values, errors = (
            np.array([table[f"{name}{end}"].values for table in tables])
            for end in ("", "_error")
        )
        ratio = np.sqrt(np.mean(errors**2)) / values.std(axis=0, ddof=1).mean()
        assert 0.56 < ratio < 1.44


def test_region_tables__roughness_is_unknown_where_it_cannot_be_seen():
    """Of surfels too far apart, of noise alone, of a model without errors, and of a region
    that is too small or bent.
    """

    def flat(point, _):
        return 0 * point[:, 0]

    def rough(point, _):
        return np.sin(point[:, 0])

    fitted, masks = _sheet(1.5, rough)
    point = fitted["surfel_position"].values
    half = point[:, 0] < 12 * np.pi  # of a cylinder, as wide as a nose
    angle = point[half, 0] / 12
    across = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    bent = fitted.isel(surfel=half).assign(shading_normal=(("surfel", "xyz"), across))
    bent["surfel_position"][:] = 12 * across + point[half] * [0, 1, 0]
    small = np.abs(point - SIDE / 2)[:, :2].max(axis=1) < 0.4 * np.sqrt(MIN_AREA)
    for case in (
        _sheet(MAX_SPACING, rough),
        _sheet(1.5, flat, noise=1),
        (fitted.drop_vars("normal_error"), masks),
        (fitted, {"face": small}),
        (bent, {"face": np.ones(half.sum(), bool)}),
    ):
        table = region_tables(*case)
        for name in ("region_albedo_contrast", "region_normal_slope"):
            assert np.isnan(table[name]).all()
            assert np.isnan(table[f"{name}_error"]).all()

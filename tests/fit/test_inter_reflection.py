"""One bounce between parts of a surface: an integrating sphere, a plate, shadows, and
its subtraction.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import ConvexHull

from skindb.errors import InputError
from skindb.fit.corrections import bounced_light, without_bounce
from skindb.optics.fresnel import fresnel_transmittance
from skindb.schema import dataset

ETA = 1.3
DIFFUSE = np.array([0.5, 0.3, 0.1])


def _points(position, normal, light, sample=None):
    n = len(position)
    lights = len(light)
    values = np.full((n, lights, 1, 3), 0.1, np.float16) if sample is None else sample
    return dataset(
        {
            "reflectance_sample": values,
            "surfel_position": position,
            "surfel_normal": normal,
            "light_position": light,
            "camera_position": np.zeros((values.shape[2], 3)),
        }
    )


def _sphere(count=1500, radius=80.0):
    """Positions, inward normals and triangles of a sphere."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (3 - np.sqrt(5)) * i
    unit = np.stack(
        [np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z],
        axis=1,
    )
    return radius * unit, -unit, ConvexHull(unit).simplices


def test_bounced_light__in_a_sphere_is_the_closed_form():
    """A lamp in the middle: all of the wall is lit alike, and a ray leaves at the angle
    at which it arrives.
    """
    position, normal, triangles = _sphere()
    ds = _points(position, normal, np.zeros((1, 3)))
    found = bounced_light(
        ds,
        np.tile(DIFFUSE, (len(position), 1)),
        np.ones((len(position), 1)),
        triangles,
        eta=ETA,
    )
    both, _ = quad(lambda c: 2 * c * fresnel_transmittance(c, ETA) ** 2, 0, 1)
    expected = DIFFUSE * fresnel_transmittance(1.0, ETA) * both
    # 64 rays, and facets instead of a sphere
    np.testing.assert_allclose(found[:, 0].mean(axis=0), expected, rtol=0.01)
    assert np.abs(found[:, 0] / expected - 1).max() < 0.05


def test_bounced_light__of_walls_in_shadow_and_of_unknown_reflectance():
    position, normal, triangles = _sphere(400)
    ds = _points(position, normal, np.zeros((2, 3)))
    diffuse = np.tile(DIFFUSE, (len(position), 1))
    visible = np.ones((len(position), 2))
    visible[:, 1] = 0
    found = bounced_light(ds, diffuse, visible, triangles)
    assert (found[:, 1] == 0).all()
    unknown = diffuse.copy()
    unknown[::7] = np.nan
    np.testing.assert_allclose(
        bounced_light(ds, unknown, visible, triangles), found, rtol=1e-5
    )


def test_bounced_light__a_plate_sends_nothing_to_itself():
    position = np.array([[x, y, 0.0] for x in range(5) for y in range(5)])
    triangles = np.array(
        [[5 * x + y, 5 * x + y + 5, 5 * x + y + 1] for x in range(4) for y in range(4)]
    )
    ds = _points(position, np.tile([0.0, 0, 1], (25, 1)), np.array([[0.0, 0, 500]]))
    assert (
        bounced_light(ds, np.full((25, 3), 0.4), np.ones((25, 1)), triangles) == 0
    ).all()


def test_bounced_light__of_other_surfels_is_refused():
    position, normal, triangles = _sphere(100)
    with pytest.raises(InputError, match=r"of the same surfels; found 100, 100 and 99"):
        bounced_light(
            _points(position, normal, np.zeros((1, 3))),
            np.ones((99, 3)),
            np.ones((100, 1)),
            triangles,
        )


@pytest.mark.parametrize("chunks", [None, {"surfel": 30}])
def test_without_bounce__takes_away_what_was_added(chunks):
    position, normal, triangles = _sphere(100)
    diffuse = np.tile(DIFFUSE, (100, 1))
    rng = np.random.default_rng(2)
    direct = rng.uniform(0.05, 0.2, (100, 1, 2, 3))
    direct[3] = np.nan
    bounced = bounced_light(
        _points(position, normal, np.zeros((1, 3))),
        diffuse,
        np.ones((100, 1)),
        triangles,
    )
    # cameras in the middle: seen along the normal
    added = (
        bounced[:, :, None]
        * diffuse[:, None, None]
        * fresnel_transmittance(1.0, 1.3)
        / np.pi
    )
    seen = _points(
        position, normal, np.zeros((1, 3)), sample=(direct + added).astype(np.float16)
    )
    back = without_bounce(
        seen if chunks is None else seen.chunk(chunks), bounced, diffuse
    )["reflectance_sample"]
    assert back.dtype == np.float16
    assert (back.chunks is None) == (chunks is None)
    np.testing.assert_allclose(back.values.astype(float), direct, rtol=2e-3)

"""Pictures of models that were fitted without light from other parts of the face, which
add it: inside of a sphere the closed form is known, and on a face it is what a fit
subtracts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import quad
from scipy.spatial import ConvexHull

from skindb.fit.corrections import bounced_light, without_bounce
from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import dipole_s
from skindb.optics.fresnel import fresnel_transmittance
from skindb.render.monte_carlo import Quality, render_monte_carlo
from skindb.render.photographs import compare_photographs
from skindb.render.scene import (
    Camera,
    Environment,
    Lighting,
    Lights,
    Surface,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.render.shading import trace_view
from skindb.schema import FitStatus, Use, dataset, label, names_of
from tests.pictures import render_view
from tests.small_face import small_face

ETA = 1.3
DIFFUSE = np.array([0.6, 0.4, 0.2])
RADIUS = 80.0


@pytest.fixture(scope="module")
def sphere() -> Surface:
    """The inside of a matt sphere."""
    i = np.arange(1500) + 0.5
    z = 1 - i / 750
    turn = np.pi * (3 - np.sqrt(5)) * i
    sine = np.sqrt(1 - z**2)
    unit = np.stack([sine * np.cos(turn), sine * np.sin(turn), z], axis=1)
    faces = ConvexHull(unit).simplices
    a, b, c = (unit[faces[:, k]] for k in range(3))
    outwards = np.einsum("nc,nc->n", np.cross(b - a, c - a), a) > 0
    faces[outwards] = faces[outwards][:, ::-1]
    diffuse = np.tile(DIFFUSE, (len(unit), 1))
    face = from_model(small_face())
    return Surface(
        RADIUS * unit,
        faces,
        -unit,
        diffuse,
        np.zeros((len(unit), 3)),
        face.model,
        s=dipole_s(diffuse, eta=ETA)[0],
        sigma_tr=np.full((len(unit), 3), 1.0),
        eta=ETA,
        inter_reflection=True,
    )


def _view() -> Camera:
    """A camera in the middle."""
    K = np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    return Camera(K, np.eye(3), np.zeros(3), np.zeros(5), 16, 16)


def _lamp() -> Lights:
    """A lamp in the middle that shines everywhere."""
    return Lights(
        np.zeros((1, 3)),
        np.full((1, 3), 1e4),
        np.full(1, 0.1),
        np.array([[0.0, 0, 1]]),
        np.zeros(1),
    )


def _shaded(surface: Surface) -> np.ndarray:
    return render_view(surface, _view(), _lamp(), terms=("diffuse",))[0]


def _monte_carlo(surface: Surface) -> np.ndarray:
    return render_monte_carlo(
        surface,
        _view(),
        Lighting(_lamp()),
        Quality(samples=16, terms=("diffuse",)),
        rng=np.random.default_rng(0),
    ).radiance


@pytest.mark.parametrize("drawn", [_shaded, _monte_carlo])
def test_pictures__of_the_inside_of_a_sphere_are_the_closed_form(
    drawn, sphere: Surface
) -> None:
    """All of the wall is lit alike, and light leaves at the angle at which it arrives."""
    added = drawn(sphere)
    direct = drawn(replace(sphere, inter_reflection=False))
    both, _ = quad(lambda c: 2 * c * fresnel_transmittance(c, ETA) ** 2, 0, 1)
    ratio = added.mean(axis=(0, 1)) / direct.mean(axis=(0, 1))
    # 64 rays, and facets instead of a sphere
    np.testing.assert_allclose(ratio - 1, DIFFUSE * both, rtol=0.015)


def test_pictures__of_a_half_sphere_under_an_even_sky_are_the_closed_form(
    sphere: Surface,
) -> None:
    """From each point of its inside, half of the cosine-weighted directions meet the half
    sphere, and all of it is lit alike: one bounce adds half of R_d.
    """
    upper = sphere.vertices[sphere.faces].mean(axis=1)[:, 2] > 0
    cup = replace(sphere, faces=sphere.faces[upper], eta=1.0)
    sky = Lighting(None, Environment(np.ones((8, 16, 3))))
    quality = Quality(samples=64, terms=("diffuse",))
    added, direct = (
        render_monte_carlo(
            replace(cup, inter_reflection=bounce),
            _view(),
            sky,
            quality,
            rng=np.random.default_rng(0),
        ).radiance.mean(axis=(0, 1))
        for bounce in (True, False)
    )
    # noise of 0.3 % in both, 64 rays for each bounce, and facets instead of a sphere
    np.testing.assert_allclose(added / direct - 1, DIFFUSE / 2, atol=0.006)


def test_from_model__adds_what_the_fit_subtracted_also_for_edits() -> None:
    model = small_face()
    assert not from_model(model).inter_reflection
    fitted = model["fitted"].to_dataset()
    model["fitted"] = fitted.assign(inter_reflection=label("inter_reflection", 1))
    assert from_model(model).inter_reflection
    assert "inter_reflection" in names_of(Use.SURVIVES_EDIT)


def test_render_view__adds_what_the_fit_subtracts() -> None:
    """The samples that a fit loses, shown by the same camera under the same light."""
    model = small_face()
    dome = model["dome"].to_dataset()
    surface = replace(from_model(model), inter_reflection=True)
    camera = cameras_from_dome(dome)[0]
    lights = lights_from_dome(dome).select(1)
    scene = RayScene(surface.vertices, surface.faces)
    shape = (len(surface.vertices), 1, 1, 3)
    geometry = {
        "surfel_position": surface.vertices,
        "surfel_normal": surface.normals,
        "light_position": lights.position,
        "camera_position": camera.centre[None],
    }
    samples = dataset({"reflectance_sample": np.full(shape, 0.01), **geometry})
    hidden = scene.occluded(surface.vertices, lights.position, normal=surface.normals)
    bounced = bounced_light(
        samples, surface.diffuse, ~hidden[:, None], surface.faces, eta=ETA
    )
    direct = without_bounce(samples, bounced, surface.diffuse, eta=ETA)
    lost = (samples - direct)["reflectance_sample"].values[:, 0, 0].astype(float)
    square = np.square(lights.position - surface.vertices).sum(axis=1)
    along = (lights.position - surface.vertices) @ -lights.axis[0] / np.sqrt(square)
    radiance = lost * lights.intensity / square[:, None] * (along > 0)[:, None]
    view = trace_view(surface, camera, scene=scene)
    pair = [
        render_view(replace(surface, inter_reflection=on), camera, lights)[0]
        for on in (False, True)
    ]
    added = pair[1] - pair[0]
    expected = view.image(view.interpolate(radiance))
    assert expected.max() > 0.01
    # the fit rounds samples of 0.01, of which up to 0.007 are lost, to half precision
    off = np.abs(added - expected) > 0.01 * expected.max()
    # normals are rounded in another way, so that single rays meet another triangle
    assert off[expected > 0].mean() < 0.005
    assert added.sum() == pytest.approx(expected.sum(), rel=0.005)


def test_compare_photographs__unfitted_surfels_are_filled() -> None:
    model = small_face()
    photograph = {
        "photograph_radiance": np.ones((1, 256, 256, 3)),
        "photograph_light": [0],
        "photograph_camera": [0],
    }
    capture = xr.DataTree.from_dict(
        {"photographs": dataset(photograph), "dome": model["dome"].to_dataset()}
    )
    (whole,) = compare_photographs(model, capture)
    assert whole.filled == 0
    fitted = model["fitted"].to_dataset()
    left = fitted["surfel_position"].values[:, 0] < 0
    fitted["fit_status"][left] = FitStatus.UNSEEN
    fitted["diffuse_reflectance"][left] = np.nan
    model["fitted"] = fitted
    (half,) = compare_photographs(model, capture)
    np.testing.assert_array_equal(half.mask, whole.mask)
    assert half.filled == pytest.approx(0.5, abs=0.03)  # the face is symmetric
    assert np.isfinite(half.rendered).all()

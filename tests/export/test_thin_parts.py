"""Light through thin parts: its amount against the octree of the renderer, and its
texture in the glTF file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from PIL import Image
from scipy import integrate

from skindb.export.gltf import export_gltf
from skindb.export.inputs import thickness, transmitted_fraction
from skindb.export.textures import skin_of
from skindb.geometry.mesh import vertex_areas
from skindb.optics.diffusion import (
    diffuse_reflectance,
    dipole_power_beyond,
    dipole_profile,
    dipole_s,
)
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.render.image import decode_srgb
from tests.export.test_gltf import chunks, picture

ETA = 1.3


def sheet(side: int, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (n, 3) of a square in the plane z = 0, and triangles that face +z."""
    x, y = (
        np.ravel(a)
        for a in np.meshgrid(*2 * [(np.arange(side) - (side - 1) / 2) * spacing])
    )
    i = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([i, i + 1, i + side], 1),
            np.stack([i + 1, i + side + 1, i + side], 1),
        ]
    )
    return np.stack([x, y, 0 * x], axis=1), faces


def plate(
    depth: float, side: int, spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Two parallel squares at this distance, with normals that point away from each other."""
    points, faces = sheet(side, spacing)
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return (
        np.concatenate([points, points - depth * up]),
        np.concatenate([up, -up]),
        np.concatenate([faces, faces[:, ::-1] + len(points)]),
    )


@pytest.mark.parametrize("distance", [0.0, 0.3, 2.0, 15.0])
def test_dipole_power_beyond__is_the_integral_of_the_profile(distance):
    absorption = np.array([0.02, 0.1])
    scattering = np.array([1.5, 0.8])
    found = dipole_power_beyond(distance, absorption, scattering, eta=ETA)
    for i in range(2):

        def ring(r, i=i):
            return (
                2
                * np.pi
                * r
                * float(dipole_profile(r, absorption[i], scattering[i], eta=ETA))
            )

        expected, error = integrate.quad(
            ring, distance, 300, limit=500, epsabs=1e-14, epsrel=1e-10
        )
        assert found[i] == pytest.approx(expected, rel=1e-6, abs=10 * error)


def test_dipole_power_beyond__at_zero_is_the_diffuse_reflectance():
    s = np.array([0.05, 0.4, 1.2])
    # sigma_t' = 1 per mm
    found = dipole_power_beyond(0.0, s * s / 3, 1 - s * s / 3, eta=ETA)
    np.testing.assert_allclose(found, diffuse_reflectance(s, eta=ETA), rtol=1e-12)


def test_thickness__of_a_plate_and_of_an_open_sheet():
    points, normals, faces = plate(3.0, 12, 2.0)
    # rays along the edge of a mesh may miss it
    inside = np.abs(points[:, :2]).max(axis=1) < 10
    # single precision
    np.testing.assert_allclose(
        thickness(points, normals, faces)[inside], 3.0, atol=1e-3
    )
    points, faces = sheet(12, 2.0)
    assert np.isinf(
        thickness(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape), faces)
    ).all()


def test_thickness__a_ray_that_leaves_through_an_opening_is_not_stopped_by_an_outer_side():
    points, _, faces = plate(3.0, 12, 2.0)
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    both = np.where(
        np.arange(len(faces))[:, None] < len(faces) / 2, faces, faces[:, ::-1]
    )  # the lower one faces up too
    assert np.isinf(thickness(points, up, both)).all()


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1.0, 2.0, 4.0])
def test_transmitted_fraction__is_that_of_the_octree(depth):
    """A plate of 40 mm lit evenly from behind: the exitance in front over R_d, in the middle."""
    points, _, faces = plate(depth, 81, 0.5)
    areas = vertex_areas(points, faces)
    sigma_tr = np.array([[0.5, 0.8, 1.25]])
    diffuse = np.array([[0.6, 0.4, 0.3]])
    s, _ = dipole_s(diffuse, eta=ETA)
    lit = np.zeros((len(points), 1))
    lit[len(points) // 2 :] = 1.0
    middle = len(points) // 4
    wanted = np.zeros(len(points), bool)
    wanted[middle] = True
    everywhere = np.ones((len(points), 1))
    exitance = subsurface_exitance(
        points,
        areas,
        lit,
        everywhere * s,
        everywhere * sigma_tr,
        eta=ETA,
        tolerance=0.02,
        receivers=wanted,
    )[0, middle]
    found = transmitted_fraction(np.array([depth]), diffuse, sigma_tr, eta=ETA)[0]
    # the near side is a sum over points 0.5 mm apart, some 0.8 / sigma_t': it is 2 %
    # off, and so is the fraction
    np.testing.assert_allclose(found, exitance / diffuse[0], rtol=0.03)


def test_transmitted_fraction__of_thick_or_unknown_skin_is_zero():
    diffuse = np.full((3, 3), 0.4)
    sigma_tr = np.array([[0.5] * 3, [np.nan] * 3, [0.5] * 3])
    found = transmitted_fraction(
        np.array([np.inf, 1.0, 1.0]), diffuse, sigma_tr, eta=ETA
    )
    assert (found[:2] == 0).all()
    assert (found[2] > 0.1).all()


def folded(model: xr.DataTree, depth: float) -> xr.DataTree:
    """The patch folded along x = 0 into a plate of this thickness."""
    fitted = model["fitted"].to_dataset()
    x, y = fitted["surfel_position"].values[:, :2].T
    z = np.where(x < 0, depth / 2, -depth / 2)
    normal = np.stack([0 * x, 0 * x, np.sign(z)], axis=1)
    model["fitted/surfel_position"].values[:] = np.stack([-np.abs(x), y, z], axis=1)
    model["fitted/surfel_normal"].values[:] = normal
    unseen = ~np.isfinite(fitted["shading_normal"].values)
    model["fitted/shading_normal"].values[:] = np.where(unseen, np.nan, normal)
    return model


def test_export_gltf__thin_parts_have_diffuse_transmission(
    model: xr.DataTree, tmp_path: Path
) -> None:
    thin = folded(model, 2.0)
    export_gltf(thin, tmp_path / "a.glb", size=64)
    document, body = chunks(tmp_path / "a.glb")
    assert "KHR_materials_diffuse_transmission" in document["extensionsUsed"]
    material = document["materials"][0]["extensions"][
        "KHR_materials_diffuse_transmission"
    ]
    image = picture(document, body, material["diffuseTransmissionTexture"]["index"])
    assert (
        material["diffuseTransmissionTexture"]
        == material["diffuseTransmissionColorTexture"]
    )
    base = decode_srgb(picture(document, body, 0) / 255.0)[..., :3]
    strength = material["diffuseTransmissionFactor"] * image[..., 3:] / 255.0
    found = strength * decode_srgb(image[..., :3] / 255.0)
    # on the front side, between surfels: u = 0.258, v = 0.508
    row = 32
    column = 16
    u = (column + 0.5) / 64
    v = (row + 0.5) / 64
    diffuse = 0.2 + 0.5 * np.array([[u, v, u * v]])
    expected = transmitted_fraction(
        np.array([2.0]), diffuse, np.array([[0.5, 0.8, 1.25]]), eta=ETA
    )[0]
    # eight bits of an sRGB colour, and values interpolated between surfels
    np.testing.assert_allclose(
        found[row, column], expected * base[row, column], rtol=0.05
    )


def test_export_gltf__thick_faces_have_no_diffuse_transmission(
    model: xr.DataTree, tmp_path: Path
) -> None:
    skin = skin_of(folded(model, 20.0), size=64)
    assert skin.transmitted < 0.01
    export_gltf(model, tmp_path / "a.glb", skin=skin)
    document, _ = chunks(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_materials_ior", "KHR_materials_specular"]


def test_export_gltf__an_alpha_channel_is_stored(model: xr.DataTree) -> None:
    skin = skin_of(folded(model, 2.0), size=64)
    assert skin.pictures["diffuseTransmission"].shape == (64, 64, 4)
    assert Image.fromarray(skin.pictures["diffuseTransmission"]).mode == "RGBA"

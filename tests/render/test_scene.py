"""Elements of a scene; a finer mesh leaves pictures as they are, and makes light under the skin
as sharp as the shadow that it crosses.
"""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.reflectance.tables import stored_brdf
from skindb.render.scene import (
    Camera,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.schema import FitStatus, dataset, label


def model(status: list[int], *, translucent: bool = True) -> xr.DataTree:
    n = 5
    rng = np.random.default_rng(0)
    position = np.array(
        [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [0, 20, 0]], float
    )
    values = {
        "surfel_position": position,
        "shading_normal": np.tile([0.0, 0, 1], (n, 1)),
        "diffuse_reflectance": rng.uniform(0.2, 0.5, (n, 3)),
        "basis_weight": rng.uniform(0, 1, (n, 2)),
        "dipole_s": rng.uniform(0.5, 1, (n, 3)),
        "fit_status": np.array(status),
        "refractive_index": 1.35,
    }
    if translucent:
        values["sigma_tr"] = rng.uniform(0.5, 1, (n, 3))
    groups = {
        "/fitted": dataset(values),
        "/mesh": dataset({"triangle": np.array([[0, 1, 2], [0, 2, 3], [2, 3, 4]])}),
        "/basis": dataset(
            {
                "basis_brdf": stored_brdf(rng.uniform(0, 1, (6, 5, 4, 2))),
                "disc_angular_radius": 0.0,
            }
        ),
    }
    return xr.DataTree.from_dict(groups)


def test_from_model__carries_every_value() -> None:
    tree = model([0, 0, 0, 0, 0])
    surface = from_model(tree)
    np.testing.assert_allclose(surface.diffuse, tree["fitted/diffuse_reflectance"])
    np.testing.assert_array_equal(
        surface.model.table[..., 1], tree["basis/basis_brdf"].values[1, ..., :-1]
    )
    assert surface.eta == 1.35
    assert surface.sigma_tr is not None
    assert from_model(model([0] * 5, translucent=False)).sigma_tr is None


def test_from_model__surfels_without_a_fit_are_filled_from_the_nearest() -> None:
    tree = model([0, 0, 0, int(FitStatus.UNSEEN), int(FitStatus.NOT_FINITE)])
    filled = from_model(tree)
    # (0, 20) is nearest to (10, 10)
    np.testing.assert_array_equal(filled.diffuse[4], filled.diffuse[2])
    np.testing.assert_array_equal(filled.vertices[4], [0, 20, 0])


def test_from_model__surfels_without_a_normal_have_that_of_the_mesh() -> None:
    """Where it looks into the head, light that comes through the back is not shown."""
    unseen = int(FitStatus.UNSEEN)
    tree = model([0, 0, 0, int(FitStatus.UNDETERMINED), unseen])
    fitted = tree["fitted"].to_dataset()
    fitted["surfel_position"][4] = [0, 10, 10]  # of a triangle that looks along -y
    fitted["shading_normal"][4] = np.nan
    fitted["shading_normal"][3] = [0.6, 0, 0.8]
    tree["fitted"] = fitted
    normals = from_model(tree).normals
    np.testing.assert_allclose(normals[3], [0.6, 0, 0.8], rtol=1e-6)
    np.testing.assert_allclose(np.abs(normals[4]), [0, 1, 0], atol=1e-6)
    assert (from_model(tree).diffuse > 0).all()
    for height, is_black in ((4.0, True), (11.0, False)):  # of a wall that looks down
        fitted["surfel_position"][4] = [5, 5, height]
        tree["fitted"] = fitted
        tree["mesh"] = dataset(
            {"triangle": np.array([[0, 1, 2], [0, 2, 3], [4, 1, 0]])}
        )
        wall = from_model(tree)
        assert wall.normals[4, 2] < 0
        assert (wall.diffuse[4] == 0).all() == is_black
        assert (wall.parameters[4] == 0).all() == is_black
        assert (wall.diffuse[:4] > 0).all()


def test_from_model__nothing_fitted_is_said() -> None:
    with pytest.raises(
        InputError, match="at least one surfel must be fitted for a picture; found none"
    ):
        from_model(model([1] * 5))


def test_from_model__missing_variables_are_listed_together() -> None:
    tree = model([0] * 5)
    tree["fitted"] = (
        tree["fitted"].to_dataset().drop_vars(["dipole_s", "shading_normal"])
    )
    with pytest.raises(
        InputError, match=r"fitted\[shading_normal\].*\n.*fitted\[dipole_s\]"
    ):
        from_model(tree)


def test_from_model__disc_of_the_tables_is_known() -> None:
    tree = model([0] * 5)
    assert not from_model(tree).model.disc_included
    basis = tree["basis"].to_dataset()
    basis["disc_angular_radius"] = label("disc_angular_radius", 0.014)
    tree["basis"] = basis
    assert from_model(tree).model.disc_included


def test_cameras_and_lights_from_dome__round_trip() -> None:
    rng = np.random.default_rng(2)
    R = np.linalg.qr(rng.normal(size=(2, 3, 3)))[0]
    dome = dataset(
        {
            "camera_matrix": rng.uniform(1, 2, (2, 3, 3)),
            "camera_rotation": R,
            "camera_translation": rng.normal(size=(2, 3)),
            "camera_distortion": rng.normal(size=(2, 5)),
            "camera_size": np.array([[30, 20], [31, 21]]),
            "light_position": rng.normal(size=(3, 3)),
            "light_intensity": rng.uniform(1, 2, (3, 3)),
            "light_disc_radius": np.full(3, 12.5),
            "light_axis": rng.normal(size=(3, 3)),
            "light_falloff": np.arange(3.0),
        }
    )
    cameras = cameras_from_dome(dome)
    lamps = lights_from_dome(dome)
    assert (cameras[1].width, cameras[1].height) == (31, 21)
    np.testing.assert_allclose(R[1] @ cameras[1].centre + cameras[1].t, 0, atol=1e-12)
    assert len(lamps) == 3
    chosen = lamps.select([2, 0])
    np.testing.assert_array_equal(chosen.falloff, [2, 0])
    np.testing.assert_array_equal(
        lamps.select(np.array([False, True, False])).position, lamps.position[1:2]
    )


def test_camera_scaled__refuses_pictures_that_do_not_fit_into_memory() -> None:
    small = Camera(np.eye(3), np.eye(3), np.zeros(3), np.zeros(5), 32, 24)
    with pytest.raises(
        InputError,
        match=r"a picture must have 1 to [\d,]+ pixels; found \d+ x \d+; choose another",
    ):
        small.scaled(1e4)


def test_camera_scaled__keeps_the_view() -> None:
    K = np.array([[50.0, 0, 16], [0, 51, 12], [0, 0, 1]])
    small = Camera(K, np.eye(3), np.zeros(3), np.zeros(5), 32, 24)
    large = small.scaled(2)
    ray = np.linalg.inv(K) @ [10, 7, 1]
    np.testing.assert_allclose(np.linalg.inv(large.K) @ [20, 14, 1], ray)
    assert (large.width, large.height) == (64, 48)

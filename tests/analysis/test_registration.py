"""Takes whose texture coordinates differ by planted warps, brought into one space by their landmarks."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.analysis.registration import correspondence_error, corresponding_points, register, unregistered
from skindb.errors import InputError
from skindb.geometry.atlas import signed_areas
from skindb.geometry.warp import apply_warp, fit_warp
from skindb.schema import FitStatus, dataset

SIDE = 33
NAMES = [f"point{i}" for i in range(9)]
STORED = 1e-6  # single precision of coordinates below 2
PLACES = np.stack(np.meshgrid([0.2, 0.5, 0.8], [0.2, 0.5, 0.8]), axis=-1).reshape(-1, 2) + 0.01


def _sheet() -> tuple[np.ndarray, np.ndarray]:
    """Even (u, v) (n, 2), v down, and triangles that are seen from outside."""
    side = np.linspace(0, 1, SIDE)
    uv = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    i = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate([np.column_stack([i, i + SIDE, i + 1]), np.column_stack([i + 1, i + SIDE, i + SIDE + 1])])
    assert (signed_areas(uv, faces) > 0).all()
    return uv, faces


def _lifted(uv: np.ndarray) -> np.ndarray:
    """The face of a subject in mm at its own parameters: a shallow cap 160 mm wide."""
    x, y = 160 * (uv[:, 0] - 0.5), -160 * (uv[:, 1] - 0.5)
    return np.column_stack([x, y, -(x**2 + y**2) / 400])


def _take(uv: np.ndarray, landmarks: np.ndarray, names=NAMES, **attrs) -> xr.DataTree:
    """A take with surfels at the sheet's points, texture coordinates of its own, landmarks at points of the sheet."""
    plane, faces = _sheet()
    status = np.full(len(plane), FitStatus.FITTED)
    groups = {
        "fitted": dataset({"surfel_position": _lifted(plane), "surfel_uv": uv, "fit_status": status}),
        "mesh": dataset({"triangle": faces, "landmark_position": landmarks}, coords={"landmark": list(names)}),
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {"consent_scope": ["statistics"], **attrs}
    return tree


def _on_sheet(places: np.ndarray) -> np.ndarray:
    """Points of the sheet's triangles at (u, v) that are its nodes."""
    plane, _ = _sheet()
    at = [np.linalg.norm(plane - p, axis=1).argmin() for p in places]
    return _lifted(plane[at])


def _nodes() -> np.ndarray:
    return np.rint(PLACES * (SIDE - 1)) / (SIDE - 1)


def _planted(seed: int, by: float = 0.03) -> np.ndarray:
    """Texture coordinates of the sheet's points after a warp that takes the landmarks elsewhere."""
    moved = _nodes() + np.random.default_rng(seed).normal(size=(9, 2)) * by
    return apply_warp(fit_warp(_nodes(), moved), _sheet()[0])


def _pair() -> dict[str, xr.DataTree]:
    points = _on_sheet(_nodes())
    return {"A": _take(_sheet()[0], points), "B": _take(_planted(1), points)}


def test_register__brings_back_a_planted_warp():
    """B's own coordinates are the thin plate of A's: with B as the reference A's warp is the one planted."""
    models = _pair()
    found = register(models, reference="B")
    np.testing.assert_allclose(found["A"]["common_uv"], _planted(1), atol=STORED)
    np.testing.assert_allclose(found["B"]["common_uv"], _planted(1), atol=STORED)
    assert {f.attrs["warp_kind"] for f in found.values()} == {"thin plate"}
    assert all(f["landmark_used"].all() and f["landmark_residual"].max() < STORED for f in found.values())
    assert found["A"].attrs["reference"] == "B"
    truth = {take: _lifted(_sheet()[0])[::7] for take in models}
    before, after = (correspondence_error(models, r, truth) for r in (unregistered(models), found))
    assert before.shape == (2, len(truth["A"]))
    assert np.nanmedian(before) > 1
    # 1e-6 of 160 mm, and triangles of 5 mm
    assert np.nanmax(after) < 1e-3
    assert np.isnan(after).mean() < 0.05  # the rim alone may leave the other


def test_register__the_mean_of_all_is_between_them():
    models = _pair()
    found = register(models)
    common = found["A"]["common_landmark"].values
    np.testing.assert_allclose(found["B"]["common_landmark"], common, atol=STORED)
    between = (
        _nodes() + _nodes() + _planted(1)[[np.linalg.norm(_sheet()[0] - p, axis=1).argmin() for p in _nodes()]]
    ) / 2
    between -= _nodes() / 2
    assert np.abs(common - between).max() < 0.01  # turn and scale are taken out; of 0.03 they differ by
    for take, model in models.items():
        for name, point in zip(NAMES, common, strict=True):
            there = corresponding_points(model, found[take], point[None])[0]
            np.testing.assert_allclose(
                there, model["mesh/landmark_position"].sel(landmark=name), atol=0.01, err_msg=f"{take} {name}"
            )


def test_register__a_missing_landmark_is_left_out():
    models, points = _pair(), _on_sheet(_nodes())
    models["B"] = _take(_planted(1), points[1:], names=NAMES[1:])
    points[4] = np.nan
    models["C"] = _take(_planted(2), points)
    found = register(models)
    assert found["B"]["landmark_used"].values.tolist() == [False] + 8 * [True]
    assert found["C"]["landmark_used"].values.tolist() == [i != 4 for i in range(9)]
    assert np.isnan(found["B"]["landmark_residual"].sel(landmark="point0"))
    assert found["A"]["landmark_used"].all()


def test_register__takes_without_landmarks_are_left_out():
    models = _pair()
    mesh = models["B"]["mesh"].to_dataset()[["triangle"]].drop_vars("landmark", errors="ignore")
    models["B"] = xr.DataTree.from_dict({"fitted": models["B"]["fitted"].to_dataset(), "mesh": mesh})
    assert list(register(models)) == ["A"]
    assert register({"B": models["B"]}) == {}
    for reference in ("B", "X"):
        with pytest.raises(InputError, match=r"reference .*takes with landmarks: A"):
            register(models, reference=reference)


def test_register__a_wrong_click_stands_out():
    models, points = _pair(), _on_sheet(_nodes())
    points[4] += [0, 16, 0]  # 0.1 of the side
    models |= {f"C{i}": _take(_planted(i, 0.005), _on_sheet(_nodes())) for i in range(3)}
    models["wrong"] = _take(_planted(3, 0.005), points)
    error = register(models)["wrong"]["landmark_prediction_error"].values
    assert error.argmax() == 4
    assert error[4] > 0.05


@pytest.mark.parametrize("swapped", [False, True])
def test_register__turns_no_triangle_over(swapped):
    """Clicks so wrong that no map through them is without folds."""
    models, points = _pair(), _on_sheet(_nodes())
    points = points[[1, 0, *range(2, 9)]] if swapped else points + np.random.default_rng(3).normal(size=(9, 3)) * 12
    models["A"] = _take(_sheet()[0], points)
    for reference in ("B", None):
        found = register(models, reference=reference)
        assert found["A"].attrs["warp_flips"] == 0
        assert (signed_areas(found["A"]["common_uv"].values, _sheet()[1]) > 0).all()
    assert not swapped or found["A"].attrs["warp_smoothing"] > 0


def test_corresponding_points__outside_is_nan():
    models = _pair()
    found = corresponding_points(models["A"], register(models)["A"], np.array([[5.0, 5.0], [0.5, 0.5], [np.nan, 0]]))
    assert np.isfinite(found).all(axis=1).tolist() == [False, True, False]

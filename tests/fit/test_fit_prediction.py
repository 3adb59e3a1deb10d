"""The table of errors by region and status, compared with sums by hand."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.errors import InputError
from skindb.fit import prediction_table
from skindb.fit.quality import (
    describe_prediction,
    tabulate_diffuse,
    tabulate_prediction,
)
from skindb.schema import FitStatus, dataset

FITTED = FitStatus.FITTED
CLAMPED = FitStatus.DIFFUSE_CLAMPED
UNSEEN = FitStatus.UNSEEN


def _fitted(**more):
    """Six surfels, one of them unseen, one clamped; the nose is three of them, the ear none."""
    nan = np.nan
    return dataset(
        {
            "fit_status": [FITTED, FITTED, FITTED, FITTED, CLAMPED, UNSEEN],
            "surfel_area": [1, 1, 1, 7, 1, 100],
            "region_mask": np.array([[1, 0], [1, 0], [0, 0], [0, 0], [1, 0], [0, 0]]),
            "fit_residual": [0.1, 0.2, 0.3, 0.4, 0.9, nan],
            "fit_residual_perceptual": [0.01, 0.02, 0.03, 0.04, 0.09, nan],
            "held_out_error": [nan, 0.2, 0.3, nan, 0.9, nan],
            "held_out_error_perceptual": [nan, 0.02, 0.03, nan, 0.09, nan],
            "outlier_fraction": [0, 0, 0.5, 0.1, 0, nan],
            **more,
        },
        coords={"region": ["nose", "ear"]},
    )


def _error(table, **where):
    return (
        table["prediction_error"]
        .sel({"region": "face", "status": "any", "space": "linear"} | where)
        .values
    )


def test_prediction_table__counts_and_weighs_by_area():
    table = prediction_table(_fitted())
    # no surfel is in the ear
    assert table["region"].values.tolist() == ["face", "nose"]
    assert table["prediction_surfels"].sel(region="face").values.tolist() == [
        6,
        4,
        1,
        0,
        0,
        1,
        *[0] * 5,
    ]
    assert table["prediction_surfels"].sel(region="nose", status="diffuse_clamped") == 1
    assert table["prediction_fraction"].sel(region="nose", status="fitted") == 2 / 3
    # of the area 11, the first three have 3 and the fourth 7, which contains the
    # median; 95 % is in the fifth
    np.testing.assert_allclose(_error(table, samples="fit"), [0.4, 0.9], rtol=1e-6)
    np.testing.assert_allclose(
        _error(table, samples="fit", region="nose"), [0.2, 0.9], rtol=1e-6
    )
    np.testing.assert_allclose(
        _error(table, samples="fit", status="fitted"), [0.4, 0.4], rtol=1e-6
    )
    np.testing.assert_allclose(
        _error(table, samples="fit", space="perceptual"), [0.04, 0.09], rtol=1e-6
    )
    np.testing.assert_allclose(
        _error(table, samples="held_out_lights"), [0.3, 0.9], rtol=1e-6
    )
    assert np.isnan(_error(table, samples="held_out_cameras")).all()
    assert np.isnan(_error(table, samples="fit", status="unseen")).all()
    np.testing.assert_allclose(
        table["prediction_outlier_fraction"].sel(region="face", status="any"),
        1.2 / 11,
        rtol=1e-6,
    )


def test_prediction_table__agrees_with_numpy_for_equal_areas():
    rng = np.random.default_rng(1)
    values = rng.lognormal(size=501)
    status = rng.choice([FITTED, CLAMPED], 501)
    mask = rng.uniform(size=(501, 2)) < 0.4
    table = prediction_table(
        dataset(
            {
                "fit_status": status,
                "surfel_area": np.ones(501),
                "region_mask": mask,
                "held_out_camera_error": values,
            },
            coords={"region": ["cheek", "chin"]},
        )
    )
    for region, inside in {
        "face": np.full(501, True),
        "cheek": mask[:, 0],
        "chin": mask[:, 1],
    }.items():
        for name, chosen in {
            "any": inside,
            "fitted": inside & (status == FITTED),
        }.items():
            found = _error(
                table, samples="held_out_cameras", region=region, status=name
            )
            known = values[chosen].astype(np.float32)
            np.testing.assert_allclose(
                found, np.quantile(known, [0.5, 0.95], method="inverted_cdf"), rtol=1e-6
            )


def test_prediction_table__surfels_without_area_have_no_weight():
    """The only clamped surfel is the corner of triangles without area."""
    table = prediction_table(_fitted(surfel_area=[1, 1, 1, 7, 0, 100]))
    clamped = table.sel(status="diffuse_clamped", region="face")
    assert clamped["prediction_surfels"] == 1
    assert np.isnan(clamped["prediction_error"]).all()
    assert np.isnan(clamped["prediction_outlier_fraction"])
    assert np.isfinite(_error(table, samples="fit")).all()


def test_prediction_table__needs_status_and_area():
    with pytest.raises(InputError, match="fit_status"):
        prediction_table(_fitted().drop_vars("fit_status"))


def test_tabulate_prediction__shows_only_what_there_is():
    table = prediction_table(_fitted())
    described = describe_prediction(table)
    assert described["regions"]["nose"]["fit"]["linear"]["median"] == pytest.approx(0.2)
    assert described["statuses"]["unseen"] == {"surfels": 1, "fraction": 1 / 6}
    header, *rows = tabulate_prediction(described)
    assert header[0] == "by area: median / 95 % [%]"
    assert header[3:] == ["fit", "roots", "unseen lights", "roots"]
    assert rows[0] == [
        "face",
        "6",
        "10.9",
        "40.0 / 90.0",
        "4.0 / 9.0",
        "30.0 / 90.0",
        "3.0 / 9.0",
    ]
    assert [row[0] for row in rows] == [
        "face",
        "nose",
        "fitted",
        "unseen",
        "diffuse_clamped",
    ]
    assert rows[-2][2:] == ["-"] * 5


def test_tabulate_diffuse__regions_with_trusted_surfels():
    colour = [[0.5, 0.4, 0.3], [0.25, 0.2, 0.15], [np.nan] * 3]
    tables = dataset(
        {
            "region_surfels": [9, 2, 0],
            "region_diffuse_reflectance": colour,
            "region_diffuse_reflectance_total_error": np.array(colour) / 10,
        },
        coords={"region": ["face", "nose", "ear"]},
    )
    assert tabulate_diffuse(tables)[1:] == [
        ["face", "9", "0.500 +- 0.050", "0.400 +- 0.040", "0.300 +- 0.030"],
        ["nose", "2", "0.250 +- 0.025", "0.200 +- 0.020", "0.150 +- 0.015"],
    ]
    assert len(tabulate_diffuse(prediction_table(_fitted()))) == 1

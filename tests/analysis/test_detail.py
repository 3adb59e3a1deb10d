"""Fine detail of one face on another."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from planted_sheet import FACE, on_sheet, sheet, sheet_take
from scipy.ndimage import gaussian_filter

from skindb.analysis import register, transfer_detail
from skindb.errors import InputError
from skindb.schema import dataset

# texels of 2.5 mm; spots are two surfels wide, 40 mm apart
SIZE = 64
COARSEST = 80.0
SPOT = 0.5  # of log R_d


def takes(**attrs):
    """A uniform face, and one that is darker everywhere and has spots."""
    plane, _ = sheet()
    places = np.array(list(FACE.values()))
    made = {}
    for name, level, spots in (("A", 0.5, 0.0), ("B", 0.3, SPOT)):
        model = sheet_take(
            plane, on_sheet(places), names=list(FACE), take=name, **attrs
        )
        log = np.log(level) - spots * spotted()
        fitted = model["fitted"].to_dataset()
        colour = np.repeat(np.exp(log)[:, None], 3, axis=1).astype(np.float32)
        extra = {
            "diffuse_reflectance": colour,
            "dipole_s": np.full((len(plane), 3), 0.5),
            "refractive_index": 1.3,
        }
        model["fitted"] = fitted.assign(dataset(extra).data_vars)
        made[name] = model
    return made


@lru_cache
def registered():
    return register(takes())


def spotted():
    """Round spots, eight surfels apart, 1 in their middle."""
    side = int(np.sqrt(len(sheet()[0])))
    spots = np.zeros((side, side))
    spots[4::8, 4::8] = 1
    spots = gaussian_filter(spots, 1.2)
    return (spots / spots.max()).ravel()


def moved(region="face", **options):
    models = takes()
    placed = registered()
    call = {
        "registered": placed["A"],
        "source_registered": placed["B"],
        "size": SIZE,
        "coarsest": COARSEST,
        **options,
    }
    tree = transfer_detail(models["A"], models["B"], region=region, **call)
    change = np.log(
        tree["fitted/diffuse_reflectance"].values
        / models["A"]["fitted/diffuse_reflectance"].values
    )
    return tree, change[:, 1], placed["A"]["common_uv"].values


def test_transfer_detail__spots_come_and_colour_stays():
    tree, change, uv = moved()
    inside = (np.abs(uv - 0.5) < 0.3).all(axis=1)
    spots = spotted() > 0.99
    between = change[inside & (spotted() < 0.05)].mean()
    depth = between - change[inside & spots].mean()
    assert depth == pytest.approx(SPOT, rel=0.25)  # the map is linear between texels
    assert np.abs(change[inside].mean()) < 0.1 * np.log(0.5 / 0.3)
    assert tree.attrs["edit"] == {
        "detail": "B",
        "region": "face",
        "coarsest_mm": COARSEST,
    }
    assert "basis_weight" in tree["fitted"]


def test_transfer_detail__of_itself_changes_nothing():
    models = takes()
    placed = registered()
    tree = transfer_detail(
        models["B"],
        models["B"],
        registered=placed["B"],
        source_registered=placed["B"],
        size=SIZE,
        coarsest=COARSEST,
    )
    np.testing.assert_array_equal(
        tree["fitted/diffuse_reflectance"], models["B"]["fitted/diffuse_reflectance"]
    )


def test_transfer_detail__stays_within_its_mask():
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:, : SIZE // 2] = True
    _, change, uv = moved(mask)
    spots = spotted() > 0.99
    left, right = (
        spots & (np.abs(uv[:, 1] - 0.5) < 0.3) & side
        for side in (uv[:, 0] < 0.4, uv[:, 0] > 0.65)
    )
    assert change[left].mean() < -0.5 * SPOT
    assert np.abs(change[right]).max() < 0.05 * SPOT


def test_transfer_detail__regions_by_name():
    _, change, _ = moved("no_beard")
    assert change.min() < -0.3 * SPOT
    with pytest.raises(InputError, match="must be a region defined by the landmarks"):
        moved("elbow")


def test_transfer_detail__refuses_what_cannot_be():
    with pytest.raises(InputError, match="four texels"):
        moved(coarsest=1.0)
    with pytest.raises(InputError, match=r"a mask must have \(64, 64\) texels"):
        moved(np.ones((3, 3), bool))
    models = takes()
    placed = registered()
    models["B"].attrs["consent_scope"] = ["fit"]
    with pytest.raises(InputError, match="statistics"):
        transfer_detail(
            models["A"],
            models["B"],
            registered=placed["A"],
            source_registered=placed["B"],
        )
    other = placed["B"].isel(landmark=slice(3))
    models = takes()
    with pytest.raises(InputError, match="registered together"):
        transfer_detail(
            models["A"], models["B"], registered=placed["A"], source_registered=other
        )

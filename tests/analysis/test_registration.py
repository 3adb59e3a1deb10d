"""Takes whose texture coordinates differ by planted warps, brought into one space by
their landmarks.
"""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from planted_sheet import (
    FACE,
    NAMES,
    SIDE,
    SIZE,
    STORED,
    face_take,
    lifted,
    nodes,
    on_sheet,
    planted_uv,
    sheet,
    sheet_pair,
    sheet_take,
)

from benchmarks.registration import (
    correspondence_error,
    corresponding_points,
    mask_agreement,
    unregistered,
)
from skindb.analysis.albedo import albedo_histograms
from skindb.analysis.regions import (
    FINE,
    region_masks,
    take_masks,
)
from skindb.analysis.registration import (
    describe_registration,
    doubtful_landmarks,
    register,
    tabulate_registration,
)
from skindb.analysis.summary import cohort_of
from skindb.errors import InputError
from skindb.geometry.atlas import signed_areas
from skindb.schema.cohort import Held, combine
from skindb.workflow.cohorts import registered_parts


def test_register__brings_back_a_planted_warp():
    """The coordinates of B are a planted warp of those of A; with B as the reference,
    the warp of A is found.
    """
    models = sheet_pair()
    found = register(models, reference="B", smoothing=0.0)
    np.testing.assert_allclose(found["B"]["common_uv"], planted_uv(1), atol=STORED)
    # of the planted 0.03: anchors lie within a triangle of 0.03
    assert np.median(np.abs(found["A"]["common_uv"] - planted_uv(1))) < 0.003
    assert {f.attrs["warp_kind"] for f in found.values()} == {"thin plate"}
    assert all(
        f["landmark_used"].all() and f["landmark_residual"].max() < STORED
        for f in found.values()
    )
    assert (found["A"].attrs["reference"], found["A"].attrs["template"]) == ("B", "B")
    assert (
        found["A"].attrs["warp_anchors"] > 150,
        found["B"].attrs["warp_anchors"],
    ) == (True, 0)
    truth = {"A": lifted(sheet()[0])[::7], "B": SIZE * lifted(sheet()[0])[::7]}
    before, after = (
        correspondence_error(models, r, truth) for r in (unregistered(models), found)
    )
    assert before.shape == (2, len(truth["A"]))
    assert np.nanmedian(before) > 1
    assert np.nanmedian(after) < 0.2 * np.nanmedian(before)
    assert np.nanquantile(after, 0.95) < 0.35 * np.nanquantile(before, 0.95)
    assert np.isnan(after).mean() < 0.06  # only the rim may leave the other surface


@pytest.mark.slow
def test_register__anchors_help_where_no_landmark_is():
    """Landmarks are in the middle of the sheet only; beyond them, points are matched by
    the surface.
    """
    models = {
        "A": sheet_take(sheet()[0], on_sheet(nodes())),
        "B": sheet_take(planted_uv(1, 0.05), on_sheet(nodes())),
    }
    few = {take: model.copy() for take, model in models.items()}
    for model in few.values():
        model["mesh"] = model["mesh"].to_dataset().isel(landmark=[1, 3, 4])
    truth = {take: on_sheet(nodes()[[0, 2, 6, 7, 8]]) for take in models}
    own, by_few = (
        correspondence_error(models, r, truth)
        for r in (unregistered(models), register(few))
    )
    assert np.nanmedian(by_few) < 0.7 * np.nanmedian(own)


@pytest.mark.slow
def test_register__the_mean_of_all_is_between_them():
    models = sheet_pair()
    found = register(models, smoothing=0.0)
    common = found["A"]["common_landmark"].values
    np.testing.assert_allclose(found["B"]["common_landmark"], common, atol=STORED)
    between = (
        nodes()
        + nodes()
        + planted_uv(1)[
            [np.linalg.norm(sheet()[0] - p, axis=1).argmin() for p in nodes()]
        ]
    ) / 2
    between -= nodes() / 2
    # rotation and scale are removed; they differ by 0.03
    assert np.abs(common - between).max() < 0.01
    for take, model in models.items():
        for name, point in zip(NAMES, common, strict=True):
            there = corresponding_points(model, found[take], point[None])[0]
            np.testing.assert_allclose(
                there,
                model["mesh/landmark_position"].sel(landmark=name),
                atol=0.01,
                err_msg=f"{take} {name}",
            )


def test_register__skips_a_missing_landmark():
    models = sheet_pair()
    points = on_sheet(nodes())
    models["B"] = sheet_take(planted_uv(1), points[1:], names=NAMES[1:])
    points[4] = np.nan
    models["C"] = sheet_take(planted_uv(2), points)
    found = register(models)
    assert found["B"]["landmark_used"].values.tolist() == [False] + 8 * [True]
    assert found["C"]["landmark_used"].values.tolist() == [i != 4 for i in range(9)]
    assert np.isnan(found["B"]["landmark_residual"].sel(landmark="point0"))
    assert found["A"]["landmark_used"].all()


def test_register__skips_takes_without_landmarks():
    models = sheet_pair()
    mesh = (
        models["B"]["mesh"]
        .to_dataset()[["triangle"]]
        .drop_vars("landmark", errors="ignore")
    )
    models["B"] = xr.DataTree.from_dict(
        {"fitted": models["B"]["fitted"].to_dataset(), "mesh": mesh}
    )
    models["C"] = sheet_take(planted_uv(2), np.full((9, 3), np.nan))
    assert list(register(models)) == ["A"]
    assert register({"B": models["B"]}) == {}
    for reference in ("B", "X"):
        with pytest.raises(InputError, match=r"reference .*takes with landmarks: A"):
            register(models, reference=reference)


@pytest.mark.slow
def test_register__a_wrong_click_stands_out():
    models = sheet_pair()
    points = on_sheet(nodes())
    points[4] += [0, 16, 0]  # 0.1 of the side
    models |= {
        f"C{i}": sheet_take(planted_uv(i, 0.005), on_sheet(nodes())) for i in range(3)
    }
    models["wrong"] = sheet_take(planted_uv(3, 0.005), points)
    error = register(models)["wrong"]["landmark_prediction_error"].values
    assert error.argmax() == 4
    assert error[4] > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["click", "swap", None])
def test_doubtful_landmarks__names_the_wrong_ones(wrong):
    models = sheet_pair()
    points = on_sheet(nodes())
    models |= {
        f"C{i}": sheet_take(planted_uv(i, 0.005), on_sheet(nodes())) for i in range(3)
    }
    points = {
        "click": points + 16 * np.eye(9)[4][:, None] * [0, 1, 0],
        "swap": points[[1, 0, *range(2, 9)]],
    }.get(wrong, points)
    models["wrong"] = sheet_take(planted_uv(3, 0.005), points)
    found = register(models)
    notes = [one for one in doubtful_landmarks(found) if one["take"] == "wrong"]
    named = {name for name in NAMES for one in notes if f" {name} " in one["reason"]}
    assert (
        named == {"click": {"point4"}, "swap": {"point0", "point1"}, None: set()}[wrong]
    )
    if wrong:
        assert notes[0] in describe_registration(found, models)


def test_doubtful_landmarks__names_a_take_whose_sides_are_swapped():
    models = sheet_pair() | {"C": sheet_take(planted_uv(2, 0.005), on_sheet(nodes()))}
    models["wrong"] = sheet_take(
        planted_uv(3, 0.005), on_sheet(nodes())[[2, 1, 0, 5, 4, 3, 8, 7, 6]]
    )
    (reason,) = (
        one["reason"]
        for one in doubtful_landmarks(register(models))
        if one["take"] == "wrong"
    )
    assert reason.startswith(
        "no map without folds fits its 9 landmarks; left and right may be swapped"
    )


def test_doubtful_landmarks__names_an_exchange_that_distorts_the_mean_of_few():
    """The mean of three takes is distorted so much that the points of all takes look
    wrong; the worst is named.
    """
    models = sheet_pair() | {
        "wrong": sheet_take(
            planted_uv(3, 0.005), on_sheet(nodes())[[7, *range(1, 7), 0, 8]]
        )
    }
    notes = doubtful_landmarks(register(models))
    assert [one["take"] for one in notes] == ["wrong"]
    assert any(f" {NAMES[i]} " in notes[0]["reason"] for i in (0, 7))


def test_tabulate__one_take_has_nothing_to_agree_with():
    header, rows = tabulate_registration(register({"A": sheet_pair()["A"]}))
    told = dict(zip(header, rows[0], strict=True))
    assert np.isnan([told["misfit_mm"], told["predicted_mm"], told["worst_mm"]]).all()
    assert told["worst"] == "-"


def test_doubtful_landmarks__of_one_take_and_of_none():
    points = on_sheet(nodes())
    points[4] += [0, 30, 0]
    wrong = {"A": sheet_take(sheet()[0], points)}
    # it is its own mean, so that there is no comparison
    assert doubtful_landmarks(register(wrong)) == []
    assert (
        doubtful_landmarks(
            register({"A": sheet_take(sheet()[0], points[:1], names=NAMES[:1])})
        )
        == []
    )
    assert doubtful_landmarks({}) == []


def test_register__takes_with_other_names():
    """Three common names are enough; without any, a take keeps the result of its own landmarks."""
    models = sheet_pair()
    points = on_sheet(nodes())
    models["few"] = sheet_take(
        planted_uv(2),
        points[[0, 2, 4, 6]],
        names=[NAMES[0], NAMES[2], NAMES[4], "mole"],
    )
    models["other"] = sheet_take(
        planted_uv(3), points, names=[f"mark{i}" for i in range(9)]
    )
    found = register(models)
    assert {take: int(one["landmark_used"].sum()) for take, one in found.items()} == {
        "A": 9,
        "B": 9,
        "few": 4,
        "other": 9,
    }
    assert found["A"].attrs["template"] in "AB"
    assert found["few"].attrs["warp_anchors"] > 100
    assert found["other"].attrs["warp_anchors"] == 0
    assert all(one.attrs["warp_flips"] == 0 for one in found.values())


def test_register__one_take_alone_stays_as_it_is():
    found = register({"B": sheet_pair()["B"]})["B"]
    np.testing.assert_allclose(found["common_uv"], planted_uv(1), atol=STORED)
    assert float(found["landmark_prediction_error"].max()) < STORED


@pytest.mark.slow
@pytest.mark.parametrize("swapped", [False, True])
def test_register__turns_no_triangle_over(swapped):
    """The clicks are so wrong that every map through them folds."""
    models = sheet_pair()
    points = on_sheet(nodes())
    points = (
        points[[1, 0, *range(2, 9)]]
        if swapped
        else points + np.random.default_rng(3).normal(size=(9, 3)) * 12
    )
    models["A"] = sheet_take(sheet()[0], points)
    for reference in ("B", None):
        found = register(models, reference=reference)
        assert found["A"].attrs["warp_flips"] == 0
        assert (signed_areas(found["A"]["common_uv"].values, sheet()[1]) > 0).all()
    assert not swapped or found["A"].attrs["warp_smoothing"] > 0


def test_corresponding_points__outside_is_nan():
    models = sheet_pair()
    found = corresponding_points(
        models["A"],
        register(models)["A"],
        np.array([[5.0, 5.0], [0.5, 0.5], [np.nan, 0]]),
    )
    assert np.isfinite(found).all(axis=1).tolist() == [False, True, False]


TEXELS = np.stack(np.meshgrid(*2 * [(np.arange(200) + 0.5) / 200]), axis=-1).reshape(
    -1, 2
)
PLACE = {
    "forehead": (0.4, 0.15),
    "nose": (0.47, 0.45),
    "cheek": (0.3, 0.47),
    "lips": (0.45, 0.59),
    "chin": (0.5, 0.68),
    "eyelid": (0.36, 0.32),
    "neck": (0.5, 0.9),
    "beard": (0.3, 0.65),
    "no_beard": (0.7, 0.47),
}


def test_region_masks__lie_where_they_should():
    masks = region_masks(TEXELS, FACE)
    assert set(masks) == set(PLACE)
    for name, place in PLACE.items():
        at = np.linalg.norm(TEXELS - place, axis=1).argmin()
        assert masks[name][at], name
        mirrored = masks[name].reshape(200, 200)[:, ::-1].ravel()
        np.testing.assert_array_equal(mirrored, masks[name], err_msg=name)
    assert (sum(masks[name].astype(int) for name in FINE) <= 1).all()
    assert not (masks["beard"] & (masks["no_beard"] | masks["lips"])).any()


def test_region_masks__move_with_the_landmarks():
    """Rotated, scaled and shifted landmarks and points give the same surfels; outlines
    are polygons.
    """
    turn = 1.3 * np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    found = region_masks(
        TEXELS @ turn + 3, {name: np.array(p) @ turn + 3 for name, p in FACE.items()}
    )
    for name, mask in region_masks(TEXELS, FACE).items():
        assert (found[name] != mask).sum() <= 2, name  # rounding at an outline


def test_region_masks__skips_regions_that_cannot_be_drawn():
    some = {name: p for name, p in FACE.items() if "ala" not in name} | {
        "chin": (np.nan, 0.0)
    }
    # all outlines are scaled with the help of the chin
    assert set(region_masks(TEXELS, some)) == set()
    some = {name: p for name, p in FACE.items() if "ala" not in name}
    assert set(region_masks(TEXELS, some)) == set(PLACE) - {"nose", "cheek", "no_beard"}


@pytest.mark.slow
def test_take_masks__the_capture_wins():
    models = {"A": face_take(own=True), "B": face_take(seed=2)}
    registered = register(models)
    upper = sheet()[0][:, 1] < 0.4
    masks = {
        take: take_masks(model, registered[take]) for take, model in models.items()
    }
    np.testing.assert_array_equal(masks["A"]["beard"], upper)
    assert not (masks["B"]["beard"] & upper).any()
    assert set(masks["A"]) == set(masks["B"]) == set(PLACE)
    assert set(take_masks(models["A"])) == {"beard"}
    area = np.ones(len(upper))
    # the same point on both faces
    assert mask_agreement(masks["A"]["lips"], masks["B"]["lips"], area) > 0.8
    assert mask_agreement(masks["A"]["beard"], masks["B"]["beard"], area) == 0
    assert np.isnan(mask_agreement(np.zeros(3, bool), np.zeros(3, bool), np.ones(3)))


def test_mask_agreement__counts_area():
    a = np.array([1, 1, 0, 0], bool)
    b = np.array([0, 1, 1, 0], bool)
    assert mask_agreement(a, b, np.array([1.0, 3.0, 2.0, 50.0])) == 0.5


@pytest.mark.slow
def test_albedo_histograms__regions_by_landmarks_where_the_capture_has_none():
    models = {"A": face_take(own=True), "B": face_take(seed=2)}
    registered = register(models)
    count = SIDE**2
    cohort = cohort_of(models, "surfels", surfels=count)
    parts = {
        take: registered_parts(model, registered[take], size=16)["sample"]
        for take, model in models.items()
    }
    drawn = combine(
        [Held.part(take, {}, one) for take, one in parts.items()],
        variables=["region_mask", "surfel_index"],
    )
    found = albedo_histograms(cohort, regions=("beard", "nose"), drawn=drawn)
    for take, model in models.items():
        for region in ("beard", "nose"):
            inside = take_masks(model, registered[take])[region]
            mean = model["fitted/diffuse_reflectance"].values[inside].mean(axis=0)
            np.testing.assert_allclose(
                found["albedo_mean"].sel(take=take, region=region), mean, rtol=1e-5
            )
    alone = albedo_histograms(cohort, regions=("beard", "nose"))
    assert np.isnan(alone["albedo_mean"].sel(take="B", region="beard")).all()


def test_register__mm_per_uv_is_of_the_face():
    """The sheet is 160 mm wide for 1 in u; its depth adds a little."""
    found = register(sheet_pair(), reference="A")
    assert float(found["A"]["mm_per_uv"]) == pytest.approx(160, rel=0.05)
    assert float(found["B"]["mm_per_uv"]) == pytest.approx(
        SIZE * float(found["A"]["mm_per_uv"]), rel=1e-6
    )


@pytest.mark.parametrize(
    ("reference", "worst"),
    [("A", {"B": 16}), ("B", {"A": 16}), (None, {"A": 8, "B": 8})],
)
def test_tabulate__a_wrong_click_is_as_many_mm_whatever_the_scale_of_an_atlas(
    reference, worst
):
    """The atlas of A covers a whole head, a quarter of which is the face; the mean of
    two takes halves the error.
    """
    points = on_sheet(nodes())
    wrong = points.copy()
    wrong[4] += [0, 16, 0]
    models = {
        "A": sheet_take(0.25 + 0.5 * sheet()[0], wrong),
        "B": sheet_take(sheet()[0], points),
    }
    header, rows = tabulate_registration(register(models, reference=reference))
    told = {row[0]: dict(zip(header, row, strict=True)) for row in rows}
    for take, mm in worst.items():
        assert told[take]["worst"] == NAMES[4]
        assert told[take]["worst_mm"] == pytest.approx(mm, rel=0.05)
    assert "template" in [one["anchors"] for one in told.values()]
    assert any(
        one["anchors"] != "template" and one["anchors"] > 80 for one in told.values()
    )


@pytest.mark.parametrize("few", [[3, 4], [1, 3, 4]])
def test_register__a_take_of_few_landmarks_is_not_the_template_of_all(few):
    points = on_sheet(nodes())
    models = {
        "A": sheet_take(sheet()[0], points),
        "B": sheet_take(planted_uv(1), points),
    }
    both = register(models, reference="A")
    models["C"] = sheet_take(planted_uv(2), points[few], names=[NAMES[i] for i in few])
    for reference in ("A", None):
        found = register(models, reference=reference)
        assert found["C"].attrs["template"] == "A"
        assert found["B"].attrs["warp_anchors"] == both["B"].attrs["warp_anchors"] > 80

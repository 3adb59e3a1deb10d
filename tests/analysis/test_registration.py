"""Takes whose texture coordinates differ by planted warps, brought into one space by their landmarks."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import xarray as xr

from skindb.analysis.albedo import albedo_histograms
from skindb.analysis.masks import FINE, inside_outline, mask_agreement, region_masks, take_masks
from skindb.analysis.registered import registration_of
from skindb.analysis.registration import (
    correspondence_error,
    corresponding_points,
    describe_registration,
    doubtful_landmarks,
    register,
    registrations,
    tabulate_registration,
    unregistered,
)
from skindb.analysis.study import analyze, read_models, register_takes
from skindb.errors import InputError
from skindb.geometry.atlas import signed_areas
from skindb.geometry.warp import apply_warp, fit_warp
from skindb.schema import FitStatus, dataset, label
from skindb.store import Database

SIDE = 33
MARK = 7.0  # no texture coordinate
SIZE = 1.1  # of B's head to A's
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


def _take(uv: np.ndarray, landmarks: np.ndarray, names=NAMES, size=1.0, **attrs) -> xr.DataTree:
    """A take with surfels at the sheet's points, texture coordinates of its own, landmarks at points of the sheet."""
    plane, faces = _sheet()
    fitted = {
        "surfel_position": _lifted(plane) * size, "surfel_uv": uv, "surfel_area": np.ones(len(uv)),
        "fit_status": np.full(len(plane), FitStatus.FITTED), "diffuse_reflectance": plane[:, [0, 1, 0]] / 2 + 0.2,
    }  # fmt: skip
    groups = {
        "fitted": dataset(fitted),
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
    """Texture coordinates of the sheet's points after a warp that takes the landmarks elsewhere; the rim stays."""
    plane, moved = _sheet()[0], _nodes() + np.random.default_rng(seed).normal(size=(9, 2)) * by
    window = 4 * np.sqrt((plane * (1 - plane)).prod(axis=1, keepdims=True))
    return plane + window * (apply_warp(fit_warp(_nodes(), moved), plane) - plane)


def _pair() -> dict[str, xr.DataTree]:
    points = _on_sheet(_nodes())
    return {"A": _take(_sheet()[0], points), "B": _take(_planted(1), points * SIZE, size=SIZE)}


def test_register__brings_back_a_planted_warp():
    """B's own coordinates are a warp of A's: with B as the reference A's warp is the one planted."""
    models = _pair()
    found = register(models, reference="B", smoothing=0.0)
    np.testing.assert_allclose(found["B"]["common_uv"], _planted(1), atol=STORED)
    # of 0.03 that were planted: anchors lie within a triangle of 0.03
    assert np.median(np.abs(found["A"]["common_uv"] - _planted(1))) < 0.003
    assert {f.attrs["warp_kind"] for f in found.values()} == {"thin plate"}
    assert all(f["landmark_used"].all() and f["landmark_residual"].max() < STORED for f in found.values())
    assert (found["A"].attrs["reference"], found["A"].attrs["template"]) == ("B", "B")
    assert (found["A"].attrs["warp_anchors"] > 150, found["B"].attrs["warp_anchors"]) == (True, 0)
    truth = {"A": _lifted(_sheet()[0])[::7], "B": SIZE * _lifted(_sheet()[0])[::7]}
    before, after = (correspondence_error(models, r, truth) for r in (unregistered(models), found))
    assert before.shape == (2, len(truth["A"]))
    assert np.nanmedian(before) > 1
    assert np.nanmedian(after) < 0.2 * np.nanmedian(before)
    assert np.nanquantile(after, 0.95) < 0.35 * np.nanquantile(before, 0.95)
    assert np.isnan(after).mean() < 0.06  # the rim alone may leave the other


def test_register__anchors_help_where_no_landmark_is():
    """Landmarks in the middle of the sheet only: beyond them the surface says where points belong."""
    models = {"A": _take(_sheet()[0], _on_sheet(_nodes())), "B": _take(_planted(1, 0.05), _on_sheet(_nodes()))}
    few = {take: model.copy() for take, model in models.items()}
    for model in few.values():
        model["mesh"] = model["mesh"].to_dataset().isel(landmark=[1, 3, 4])
    truth = {take: _on_sheet(_nodes()[[0, 2, 6, 7, 8]]) for take in models}
    own, by_few = (correspondence_error(models, r, truth) for r in (unregistered(models), register(few)))
    assert np.nanmedian(by_few) < 0.7 * np.nanmedian(own)


def test_registrations__come_one_after_the_other():
    models = _pair()
    first = next(iter(registrations(models)))
    assert first[0] == "A"
    xr.testing.assert_identical(first[1], register(models)["A"])


def test_register__the_mean_of_all_is_between_them():
    models = _pair()
    found = register(models, smoothing=0.0)
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
    models["C"] = _take(_planted(2), np.full((9, 3), np.nan))
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


@pytest.mark.parametrize("wrong", ["click", "swap", None])
def test_doubtful_landmarks__names_the_wrong_ones(wrong):
    models, points = _pair(), _on_sheet(_nodes())
    models |= {f"C{i}": _take(_planted(i, 0.005), _on_sheet(_nodes())) for i in range(3)}
    points = {"click": points + 16 * np.eye(9)[4][:, None] * [0, 1, 0], "swap": points[[1, 0, *range(2, 9)]]}.get(
        wrong, points
    )
    models["wrong"] = _take(_planted(3, 0.005), points)
    found = register(models)
    lines = [line for line in doubtful_landmarks(found) if line.startswith("wrong")]
    named = {name for name in NAMES for line in lines if f" {name} " in line}
    assert named == {"click": {"point4"}, "swap": {"point0", "point1"}, None: set()}[wrong]
    if wrong:
        assert f"registration: {lines[0]}" in describe_registration(found, models)


def test_doubtful_landmarks__names_a_take_whose_sides_are_swapped():
    models = _pair() | {"C": _take(_planted(2, 0.005), _on_sheet(_nodes()))}
    models["wrong"] = _take(_planted(3, 0.005), _on_sheet(_nodes())[[2, 1, 0, 5, 4, 3, 8, 7, 6]])
    (line,) = (line for line in doubtful_landmarks(register(models)) if line.startswith("wrong"))
    assert line.startswith("wrong: no map without folds goes by its 9 landmarks: left and right may be swapped")


def test_doubtful_landmarks__names_an_exchange_though_it_bends_the_mean_of_few():
    """Of three takes the mean is bent so far that every take's points look wrong: the worst is named."""
    models = _pair() | {"wrong": _take(_planted(3, 0.005), _on_sheet(_nodes())[[7, *range(1, 7), 0, 8]])}
    lines = doubtful_landmarks(register(models))
    assert [line.partition(":")[0] for line in lines] == ["wrong"]
    assert any(f" {NAMES[i]} " in lines[0] for i in (0, 7))


def test_tabulate__one_take_has_nothing_to_agree_with():
    header, rows = tabulate_registration(register({"A": _pair()["A"]}))
    told = dict(zip(header, rows[0], strict=True))
    assert np.isnan([told["misfit_mm"], told["predicted_mm"], told["worst_mm"]]).all()
    assert told["worst"] == "-"


def test_doubtful_landmarks__of_one_take_and_of_none():
    points = _on_sheet(_nodes())
    points[4] += [0, 30, 0]
    wrong = {"A": _take(_sheet()[0], points)}
    assert doubtful_landmarks(register(wrong)) == []  # it is its own mean: nothing to go by
    assert doubtful_landmarks(register({"A": _take(_sheet()[0], points[:1], names=NAMES[:1])})) == []
    assert doubtful_landmarks({}) == []


def test_register__takes_with_other_names():
    """Three names in common are enough; where there are none, a take keeps what its landmarks alone give."""
    models = _pair()
    points = _on_sheet(_nodes())
    models["few"] = _take(_planted(2), points[[0, 2, 4, 6]], names=[NAMES[0], NAMES[2], NAMES[4], "mole"])
    models["other"] = _take(_planted(3), points, names=[f"mark{i}" for i in range(9)])
    found = register(models)
    assert {take: int(one["landmark_used"].sum()) for take, one in found.items()} == {
        "A": 9, "B": 9, "few": 4, "other": 9,
    }  # fmt: skip
    assert found["A"].attrs["template"] in "AB"
    assert found["few"].attrs["warp_anchors"] > 100
    assert found["other"].attrs["warp_anchors"] == 0
    assert all(one.attrs["warp_flips"] == 0 for one in found.values())


def test_register__one_take_alone_stays_as_it_is():
    found = register({"B": _pair()["B"]})["B"]
    np.testing.assert_allclose(found["common_uv"], _planted(1), atol=STORED)
    assert float(found["landmark_prediction_error"].max()) < STORED


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


FACE = {
    "forehead_centre": (0.50, 0.12), "forehead_right": (0.35, 0.15), "brow_right": (0.385, 0.25), "nasion": (0.5, 0.33),
    "nose_tip": (0.5, 0.43), "subnasale": (0.5, 0.53), "ala_right": (0.41, 0.52), "eye_outer_right": (0.32, 0.37),
    "eye_inner_right": (0.41, 0.355), "mouth_corner_right": (0.372, 0.595), "lip_upper": (0.5, 0.554),
    "chin": (0.5, 0.712), "jaw_right": (0.231, 0.676),
}  # fmt: skip
FACE |= {name.replace("right", "left"): (1 - u, v) for name, (u, v) in FACE.items() if "right" in name}
TEXELS = np.stack(np.meshgrid(*2 * [(np.arange(200) + 0.5) / 200]), axis=-1).reshape(-1, 2)
PLACE = {
    "forehead": (0.4, 0.15), "nose": (0.47, 0.45), "cheek": (0.3, 0.47), "lips": (0.45, 0.59), "chin": (0.5, 0.68),
    "eyelid": (0.36, 0.32), "neck": (0.5, 0.9), "beard": (0.3, 0.65), "no_beard": (0.7, 0.47),
}  # fmt: skip


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
    """Turned, scaled and shifted landmarks and points: the same surfels. Outlines are no more than corners."""
    turn = 1.3 * np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    found = region_masks(TEXELS @ turn + 3, {name: np.array(p) @ turn + 3 for name, p in FACE.items()})
    for name, mask in region_masks(TEXELS, FACE).items():
        assert (found[name] != mask).sum() <= 2, name  # rounding at an outline


def test_region_masks__what_cannot_be_drawn_is_left_out():
    some = {name: p for name, p in FACE.items() if "ala" not in name} | {"chin": (np.nan, 0.0)}
    assert set(region_masks(TEXELS, some)) == set()  # the chin is part of the measure of every outline
    some = {name: p for name, p in FACE.items() if "ala" not in name}
    assert set(region_masks(TEXELS, some)) == set(PLACE) - {"nose", "cheek", "no_beard"}


def test_inside_outline__is_odd_winding():
    rng = np.random.default_rng(0)
    for _ in range(20):
        outline, points = rng.normal(size=(9, 2)), rng.normal(size=(500, 2))
        inside = inside_outline(points, outline)
        angles = np.arctan2(*(outline[None] - points[:, None])[..., ::-1].T).T
        turns = np.diff(np.concatenate([angles, angles[:, :1]], axis=1), axis=1)
        winding = np.rint(((turns + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)).astype(int)
        np.testing.assert_array_equal(inside, winding % 2 == 1)


def _face_take(own: bool = False, seed: int = 1) -> xr.DataTree:
    """A take with the landmarks of a face, and with a beard of its own that is the forehead."""
    names = list(FACE)
    take = _take(_planted(seed, 0.01), _lifted(np.array([FACE[n] for n in names])), names=names)
    if own:
        upper = (_sheet()[0][:, 1] < 0.4)[:, None]
        mask = dataset({"region_mask": upper}, coords={"region": ["beard"]})
        take["fitted"] = take["fitted"].to_dataset().merge(mask)
    return take


def test_take_masks__the_capture_wins():
    models = {"A": _face_take(own=True), "B": _face_take(seed=2)}
    registered = register(models)
    upper = _sheet()[0][:, 1] < 0.4
    masks = {take: take_masks(model, registered[take]) for take, model in models.items()}
    np.testing.assert_array_equal(masks["A"]["beard"], upper)
    assert not (masks["B"]["beard"] & upper).any()
    assert set(masks["A"]) == set(masks["B"]) == set(PLACE)
    assert set(take_masks(models["A"])) == {"beard"}
    area = np.ones(len(upper))
    assert mask_agreement(masks["A"]["lips"], masks["B"]["lips"], area) > 0.8  # the same place of both faces
    assert mask_agreement(masks["A"]["beard"], masks["B"]["beard"], area) == 0
    assert np.isnan(mask_agreement(np.zeros(3, bool), np.zeros(3, bool), np.ones(3)))


def test_mask_agreement__counts_area():
    a, b = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    assert mask_agreement(a, b, np.array([1.0, 3.0, 2.0, 50.0])) == 0.5


def test_albedo_histograms__regions_by_landmarks_where_the_capture_has_none():
    models = {"A": _face_take(own=True), "B": _face_take(seed=2)}
    registered = register(models)
    found = albedo_histograms(models, regions=("beard", "nose"), registered=registered)
    assert found.attrs["regions_by_landmarks"] == {"beard": ["B"], "nose": ["A", "B"]}
    for take, model in models.items():
        for region in ("beard", "nose"):
            inside = take_masks(model, registered[take])[region]
            mean = model["fitted/diffuse_reflectance"].values[inside].mean(axis=0)
            np.testing.assert_allclose(found["albedo_mean"].sel(take=take, region=region), mean, rtol=1e-5)
    alone = albedo_histograms(models, regions=("beard", "nose"))
    assert np.isnan(alone["albedo_mean"].sel(take="B", region="beard")).all()
    assert alone.attrs["regions_by_landmarks"] == {}


def _stored(tmp_path, models: dict[str, xr.DataTree]) -> Database:
    db = Database(tmp_path / "db")
    for take, model in models.items():
        with db.stage("model", take) as stage:
            stage.write({str(name): node.to_dataset() for name, node in model.children.items()})
            stage.commit(model.attrs)
    return db


def test_study__albedo_says_what_the_registration_is_worth(tmp_path):
    models = {"A": _face_take(own=True), "B": _face_take(seed=2), "C": _face_take(seed=3)}
    models["C"]["mesh"] = models["C"]["mesh"].to_dataset().drop_dims("landmark")
    db = _stored(tmp_path, models)
    record, tree = analyze(db, "albedo")
    said = record.provenance["registration"]
    assert said[0].startswith("registration: 2 takes by at most 20 landmarks (thin plate); a landmark is ")
    assert said[1:] == ["registration: C has no landmarks"]
    mean = tree["albedo"]["albedo_mean"]
    assert mean["region"].values.tolist() == ["face", "beard", "no_beard"]
    assert np.isfinite(mean.sel(take=["A", "B"])).all()
    assert np.isnan(mean.sel(take="C", region="beard")).all()
    register_takes(db)  # the study is the same with what is stored, and says so
    again, stored = analyze(db, "albedo")
    xr.testing.assert_identical(stored["albedo"].to_dataset().load(), tree["albedo"].to_dataset().load())
    assert again.provenance["registration"] == [*said, "registration: the stored one"]
    versions = [{"kind": "registration", "take": take, "generation": 1} for take in "AB"]
    assert again.provenance["inputs"] == [*record.provenance["inputs"], *versions]


def test_register_takes__commits_what_register_finds(tmp_path):
    models = {"A": _face_take(), "B": _face_take(seed=2), "silent": _face_take(seed=3)}
    models["silent"].attrs["consent_scope"] = ["fit"]
    db = _stored(tmp_path, models)
    records, found = register_takes(db)
    assert list(records) == list(found) == db.takes("registration") == ["A", "B"]
    stored = db.read("registration", "A")
    want = register({take: models[take] for take in "AB"})["A"]
    np.testing.assert_array_equal(stored["registration/common_uv"], want["common_uv"])
    assert [one["take"] for one in stored.attrs["inputs"]] == ["A", "B"]
    header, rows = tabulate_registration(found)
    row = dict(zip(header, rows[0], strict=True))
    error = want["landmark_prediction_error"] * want.attrs["mm_per_uv"]
    assert (row["take"], row["warp"], row["landmarks"]) == ("A", "thin plate", 20)
    assert row["worst_mm"] == pytest.approx(float(error.max()))
    assert row["worst"] == str(error["landmark"].values[error.values.argmax()])
    plain = {"A": _take(_sheet()[0], _on_sheet(_nodes())[:1], names=NAMES[:1])}
    one = _stored(tmp_path / "one", plain)
    register_takes(one)
    assert tabulate_registration({"A": one.read("registration", "A")["registration"].to_dataset()})[1][0][1] == "shift"
    bare = xr.DataTree.from_dict({"fitted": plain["A"]["fitted"].to_dataset()})
    bare.attrs = {"consent_scope": ["statistics"]}
    with pytest.raises(InputError, match="a registration needs landmarks"):
        register_takes(_stored(tmp_path / "bare", {"A": bare}))


def _marked(registered: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    return {
        take: one.assign(common_uv=label("common_uv", np.full(one["common_uv"].shape, MARK)))
        for take, one in registered.items()
    }


def _replace(db: Database, kind: str, take: str, version: xr.DataTree, **changed: str) -> None:
    """A newer version like this one."""
    with db.stage(kind, take) as stage:
        stage.write({str(name): node.to_dataset().compute() for name, node in version.children.items()})
        stage.commit(version.attrs | changed)


def test_registration_of__what_is_stored_is_used_only_while_it_is_current(tmp_path):
    """Stored coordinates are marked, so that a study that uses them when it must not is seen."""
    models = {"A": _face_take(), "B": _face_take(seed=2), "bare": _face_take(seed=3)}
    models["bare"]["mesh"] = models["bare"]["mesh"].to_dataset().drop_dims("landmark")
    db = _stored(tmp_path, models)

    def used(*takes: str) -> list[str]:
        """Takes whose stored coordinates a study of these takes gets."""
        read = read_models(db, takes)
        registered, versions = registration_of(db, read)
        assert list(registered) == [take for take in read if take != "bare"]
        found = [take for take, one in registered.items() if (one["common_uv"] == MARK).all()]
        assert [one["take"] for one in versions] == found
        assert [one["generation"] for one in versions] == [db.record("registration", t).generation for t in found]
        return found

    def store(*takes: str, by: str | None = None) -> None:
        """Register these takes; the coordinates stored are all MARK."""
        with mock.patch("skindb.analysis.study.registrations", lambda *a, **k: _marked(register(*a, **k)).items()):
            register_takes(db, takes=takes, reference=by)

    assert used() == []  # nothing is stored
    store()
    assert used() == ["A", "B"]
    assert used("B", "A") == ["B", "A"]
    assert used("A") == []  # the mean shape of both is not A's
    store("A")
    assert used("A") == ["A"]
    assert used() == []  # A's is that of A alone
    store(by="B")
    assert used() == ["A", "B"]
    _replace(db, "registration", "A", db.read("registration", "A", generation=1))  # of a run without the reference
    assert used() == []
    store()
    assert used() == ["A", "B"]
    _replace(db, "registration", "B", db.read("registration", "B"), software_version="0.0.1")
    assert used() == []
    store()
    _replace(db, "model", "B", models["B"])  # fitted again
    assert used() == []
    store()
    assert used() == ["A", "B"]
    models["C"] = _face_take(seed=4)
    _replace(db, "model", "C", models["C"])  # one take more
    assert used() == []
    assert used("A", "B") == ["A", "B"]


def test_registration_of__a_database_made_anew_has_no_registration_of_the_old(tmp_path):
    """Versions are known by their paths: the first model of the new database is the second one of the old."""
    models = {"A": _face_take()}
    db, other = _stored(tmp_path, models), _stored(tmp_path / "other", models)
    register_takes(other)
    _replace(db, "registration", "A", other.read("registration", "A"))
    assert registration_of(db, read_models(db))[1] == []
    assert registration_of(other, read_models(other))[1] != []


def test_registration_of__coordinates_stay_in_the_database(tmp_path):
    db = _stored(tmp_path, {"A": _face_take(), "B": _face_take(seed=2)})
    register_takes(db)
    registered, _ = registration_of(db, read_models(db))
    assert all(one["common_uv"].chunks is not None for one in registered.values())
    assert all(isinstance(one["common_landmark"].variable._data, np.ndarray) for one in registered.values())


def test_register__mm_per_uv_is_of_the_face():
    """The sheet is 160 mm wide for 1 in u; its depth adds a little."""
    found = register(_pair(), reference="A")
    assert found["A"].attrs["mm_per_uv"] == pytest.approx(160, rel=0.05)
    assert found["B"].attrs["mm_per_uv"] == pytest.approx(SIZE * found["A"].attrs["mm_per_uv"], rel=1e-6)


@pytest.mark.parametrize(("reference", "worst"), [("A", {"B": 16}), ("B", {"A": 16}), (None, {"A": 8, "B": 8})])
def test_tabulate__a_wrong_click_is_as_many_mm_whatever_the_scale_of_an_atlas(reference, worst):
    """A's atlas is of a whole head, of which the face takes a quarter; the mean of both takes halves the click."""
    points = _on_sheet(_nodes())
    wrong = points.copy()
    wrong[4] += [0, 16, 0]
    models = {"A": _take(0.25 + 0.5 * _sheet()[0], wrong), "B": _take(_sheet()[0], points)}
    header, rows = tabulate_registration(register(models, reference=reference))
    told = {row[0]: dict(zip(header, row, strict=True)) for row in rows}
    for take, mm in worst.items():
        assert told[take]["worst"] == NAMES[4]
        assert told[take]["worst_mm"] == pytest.approx(mm, rel=0.05)
    assert "template" in [one["anchors"] for one in told.values()]
    assert any(one["anchors"] != "template" and one["anchors"] > 80 for one in told.values())


@pytest.mark.parametrize("few", [[3, 4], [1, 3, 4]])
def test_register__a_take_of_few_landmarks_is_not_the_template_of_all(few):
    points = _on_sheet(_nodes())
    models = {"A": _take(_sheet()[0], points), "B": _take(_planted(1), points)}
    both = register(models, reference="A")
    models["C"] = _take(_planted(2), points[few], names=[NAMES[i] for i in few])
    for reference in ("A", None):
        found = register(models, reference=reference)
        assert found["C"].attrs["template"] == "A"
        assert found["B"].attrs["warp_anchors"] == both["B"].attrs["warp_anchors"] > 80

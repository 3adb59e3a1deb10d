"""Joint modes of faces: the model finds planted modes, conditional means, distances and errors."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.linalg import subspace_angles
from scipy.spatial.transform import Rotation
from small_face import small_face

from skindb.analysis import (
    condition_face_model,
    face_at,
    face_model,
    move_along_modes,
    sample_faces,
    write_face_model,
)
from skindb.analysis.components import (
    describe_face_model,
    plot_face_model,
    tabulate_face_model,
)
from skindb.analysis.face_models import face_maps, face_vector
from skindb.errors import InputError
from skindb.geometry.mesh import vertex_normals

mpl.use("Agg")

SIDE = 8
MODES = 2
NAMES = [
    *"xyz",
    *(f"log R_d {c}" for c in "RGB"),
    "surface reflectance",
    *(f"log sigma_tr {c}" for c in "RGB"),
]
# standard deviation of each quantity by the modes, per year of age, and of the noise
SPREAD = np.repeat([1.0, 0.2, 0.004, 0.1], [3, 3, 1, 3])[:, None, None]
PER_YEAR = 0.02
NOISE = 0.05
BLOCKS = {"shape": slice(0, 3), "albedo": slice(3, 6), "gloss": slice(6, 7)}
BLOCKS["translucency"] = slice(7, 10)


def planted(seed=0):
    """Mean face, modes and effect of a year (quantity, v, u); they do not move the shape
    as a whole, which the alignment removes.
    """
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE] * 2)
    x, y = 160 * (u - 0.5), -160 * (v - 0.5)
    mean = np.empty((10, SIDE, SIDE))
    mean[:3] = x, y, 60 - (x**2 + y**2) / 200
    mean[:3] -= mean[:3].mean(axis=(1, 2), keepdims=True)
    mean[3:6] = np.log([0.5, 0.3, 0.2])[:, None, None]
    mean[6] = 0.04
    mean[7:] = np.log([0.6, 1.0, 1.5])[:, None, None]
    fields = rng.normal(size=(MODES + 1, 10, SIDE, SIDE))
    place = mean[:3].reshape(3, -1)
    turns = [np.cross(axis, place.T).T.ravel() for axis in np.eye(3)]
    moves = [np.repeat(axis, SIDE**2) for axis in np.eye(3)]
    rigid = np.linalg.qr(np.array(turns + moves).T)[0]
    flat = fields[:, :3].reshape(MODES + 1, -1)
    fields[:, :3] = (flat - flat @ rigid @ rigid.T).reshape(fields[:, :3].shape)
    return mean, fields[:MODES] * SPREAD, PER_YEAR * fields[MODES] * SPREAD


def faces_of(scores, ages, seed=1, noise=NOISE):
    """Vectors (n, quantity, v, u) of planted faces."""
    mean, modes, year = planted()
    rng = np.random.default_rng(seed)
    error = noise * SPREAD * rng.normal(size=(len(scores), *mean.shape))
    change = np.multiply.outer(np.asarray(ages) - 40, year)
    return mean + np.tensordot(scores, modes, 1) + change + error


def cohort_of(vectors, **coords):
    """A cohort of maps of faces (n, quantity, v, u)."""
    takes = [f"T{i}" for i in range(len(vectors))]
    faces = [as_maps(vector) for vector in vectors]
    cohort = xr.concat(faces, dim="take").assign_coords(take=takes)
    subject = coords.pop("subject", takes)
    condition = coords.pop("condition", ["normal"] * len(takes))
    coords |= {"subject": subject, "condition": condition}
    return cohort.assign_coords({k: ("take", v) for k, v in coords.items()})


def as_maps(vector):
    return face_maps(xr.DataArray(vector, {"quantity": NAMES}, ("quantity", "v", "u")))


def population(n=60, seed=0):
    """A cohort of n subjects, and their scores."""
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=(n, MODES))
    ages = rng.integers(20, 70, size=n).astype(float)
    return cohort_of(faces_of(scores, ages), age=ages), scores


@pytest.fixture(scope="module")
def model():
    cohort, _ = population()
    rng = np.random.default_rng(0)
    return face_model(cohort, k=MODES, adjust=["age"], rng=rng)


def test_face_model__finds_planted_modes_and_slopes(model):
    _, modes, year = planted()
    scale = model["face_scale"].values[:, None, None]
    found, truth = (
        (fields / scale).reshape(MODES, -1).T
        for fields in (model["face_mode"].values, modes)
    )
    # noise of 0.05 in 640 entries turns modes of 60 subjects by about 0.05 / sqrt(60)
    assert subspace_angles(found, truth).max() < 0.02
    # covariance between blocks: shape with albedo; 60 subjects know it to 1/sqrt(60)
    cross = np.einsum(
        "kqvu,krvu->qr", model["face_mode"].values, model["face_mode"].values
    )
    planted_cross = np.einsum("kqvu,krvu->qr", modes, modes)
    np.testing.assert_allclose(
        np.linalg.norm(cross[:3, 3:6]), np.linalg.norm(planted_cross[:3, 3:6]), rtol=0.4
    )
    slope = model["face_slope"].values[0]
    # of 60 subjects within 14 years of the mean: an error of 1 / (14 sqrt(60)) of a mode
    error = np.sqrt(np.mean(((slope - year) / SPREAD) ** 2))
    assert error < 3 * np.sqrt(MODES) / (14 * np.sqrt(60))
    assert np.sqrt(np.mean((slope / SPREAD) ** 2)) == pytest.approx(PER_YEAR, rel=0.5)
    assert list(model["block"].values) == list(BLOCKS)
    ratio = model["mode_variance_ratio"]
    assert ratio.sum("mode").values == pytest.approx(1, abs=0.02)
    # Tipping and Bishop: the variance of a mode less that of the noise
    square = ((model["face_mode"] / model["face_scale"]) ** 2).sum(
        ["quantity", "v", "u"]
    )
    noise = float(model["noise_variance"])
    assert (ratio.sum("block") - square).values == pytest.approx(noise, rel=0.05)


def test_move_along_modes__moves_a_model_by_a_planted_step(model):
    """At the centres of texels; the take has other axes than the mean."""
    face = small_face()
    rng = np.random.default_rng(0)
    count = face["fitted"].sizes["surfel"]
    at = rng.integers(SIDE, size=(count, 2))  # u, v
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3])
    mean, mode = (
        model[name].values[..., at[:, 1], at[:, 0]]
        for name in ("face_mean", "face_mode")
    )
    place = turn.apply(mean[:3].T) + np.array([5, 0, 20])
    fitted = face["fitted"].to_dataset()
    fitted["surfel_position"] = fitted["surfel_position"].copy(data=place)
    face["fitted"] = xr.DataTree(fitted)
    step = 1.5 * mode[1]
    tree = move_along_modes(face, [0, 1.5], faces=model, uv=(at + 0.5) / SIDE)
    found = tree["fitted"].to_dataset()
    # single precision
    shift = found["surfel_position"] - place
    np.testing.assert_allclose(shift, turn.apply(step[:3].T), atol=1e-4)
    for name, factor in (
        ("diffuse_reflectance", np.exp(step[3:6])),
        ("basis_weight", 1 + step[6:7] / mean[6:7]),
        ("sigma_tr", np.exp(step[7:])),
    ):
        expected = np.minimum(
            fitted[name] * factor.T, 0.999 if name == "diffuse_reflectance" else np.inf
        )
        np.testing.assert_allclose(found[name], expected, rtol=1e-4)
    np.testing.assert_allclose((found["shading_normal"] ** 2).sum("xyz"), 1, rtol=1e-4)


def test_move_along_modes__normals_are_those_of_the_moved_surface(model):
    """A mean and a mode of the shape of the face itself: z is stretched."""
    face = small_face()
    place = face["fitted/surfel_position"].values.astype(float)
    stretched = place * [1, 1, 0.3]
    side = round(np.sqrt(len(place)))
    maps = np.zeros((2, 10, side, side))
    maps[0, :3] = place.T.reshape(3, side, side)
    maps[0, 6] = 1
    maps[1, :3] = (stretched - place).T.reshape(3, side, side)
    faces = xr.Dataset(
        {
            "face_mean": (("quantity", "v", "u"), maps[0]),
            "face_mode": (("mode", "quantity", "v", "u"), maps[1:]),
        },
        {"quantity": NAMES},
    )
    v, u = np.divmod(np.arange(len(place)), side)
    uv = (np.stack([u, v], axis=1) + 0.5) / side
    found = move_along_modes(face, [1], faces=faces, uv=uv)["fitted/shading_normal"]
    expected = vertex_normals(stretched, face["mesh/triangle"].values)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_condition__equals_the_conditional_mean_of_the_covariance(model):
    """Closed form with the whole covariance matrix, for a block and for half of the face."""
    mean, _, _ = planted()
    rng = np.random.default_rng(5)
    truth = faces_of(rng.normal(size=(1, MODES)), [55])[0]
    scale = np.broadcast_to(
        model["face_scale"].values[:, None, None], mean.shape
    ).ravel()
    modes = model["face_mode"].values.reshape(MODES, -1).astype(float)
    noise = float(model["noise_variance"])
    covariance = modes.T @ modes + noise * np.diag(scale**2)
    expected = face_vector(face_at(model, age=55)).values.ravel()
    maps = as_maps(truth)
    upper = maps.where(xr.DataArray(np.arange(SIDE) < SIDE // 2, dims="v"))
    for observed in (
        maps[["texel_diffuse_reflectance"]],
        upper.drop_vars("texel_surfel_position"),
    ):
        found = condition_face_model(model, observed, age=55)
        known = face_vector(observed).reindex(quantity=NAMES).values.ravel()
        is_known = np.isfinite(known)
        inside = covariance[np.ix_(is_known, is_known)]
        gain = np.linalg.solve(inside, covariance[is_known]).T
        wanted = expected + gain @ (known - expected)[is_known]
        np.testing.assert_allclose(
            found["face_mean"].values.ravel(), wanted, rtol=1e-4, atol=1e-4
        )
        remaining = covariance - gain @ covariance[is_known]
        posterior = found["face_mode"].values.reshape(MODES, -1)
        unknown = ~is_known
        np.testing.assert_allclose(
            np.einsum("kd,kd->d", posterior, posterior)[unknown],
            (np.diag(remaining) - noise * scale**2)[unknown],
            rtol=1e-3,
            atol=1e-9,
        )
        density = stats.multivariate_normal(
            cov=(inside / np.outer(scale[is_known], scale[is_known]))
        ).logpdf(((known - expected) / scale)[is_known])
        assert found.attrs["log_density"] == pytest.approx(density, rel=1e-6)


def test_condition__predicts_the_shape_from_the_albedo(model):
    """The planted blocks depend on the same scores: little of the shape is left."""
    truth = faces_of(np.array([[1.5, -1.0]]), [40], seed=9)[0]
    found = condition_face_model(
        model, as_maps(truth)[["texel_diffuse_reflectance"]], age=40
    )
    error = found["face_mean"].values[:3] - truth[:3]
    before = face_vector(face_at(model, age=40)).values[:3] - truth[:3]
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(before**2))


def test_distances__follow_their_law():
    """Hotelling: with v degrees of freedom, d^2 (v - k + 1) / (v k (1 + h)) ~ F(k, v - k + 1)."""
    cohort, _ = population(n=80, seed=3)
    ages = cohort["age"].values
    vectors = [face_vector(cohort.isel(take=i)).values for i in range(80)]
    plain = [
        x - (age - 40) * planted()[2] for x, age in zip(vectors, ages, strict=True)
    ]
    model = face_model(cohort_of(plain), k=MODES, rng=np.random.default_rng(0))
    free = 80 - 2
    ratio = (free - MODES + 1) / (free * MODES * (1 + 1 / 79))
    law = stats.f(MODES, free - MODES + 1)
    assert (
        stats.kstest(model["face_distance"].values ** 2 * ratio, law.cdf).pvalue > 0.01
    )
    # the p of faces that the model was not made from is uniform: the test of two samples at 1 %
    rng = np.random.default_rng(4)
    new = faces_of(rng.normal(size=(150, MODES)), [40] * 150, seed=6)
    p = [condition_face_model(model, as_maps(face)).attrs["p"] for face in new]
    limit = 1.63 * np.sqrt(1 / 150 + 1 / 80)
    assert stats.kstest(p, "uniform").statistic < limit


def test_condition__parts_of_faces_have_no_p(model):
    """Their densities are of fewer entries than those of the subjects."""
    face = as_maps(faces_of([[0, 0]], [40])[0])
    assert "p" in condition_face_model(model, face).attrs
    part = condition_face_model(model, face[["texel_diffuse_reflectance"]]).attrs
    assert "p" not in part
    assert part["log_density"] != 0


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (["a", "b"] * 6, "must be the same in all takes of a subject"),
        (["a"] * 12, "must differ between subjects; found a"),
        ([""] * 12, "must differ between subjects; found no value"),
    ],
)
def test_face_model__refuses_attributes_that_it_would_ignore(values, said):
    subject = [f"S{i // 2}" for i in range(12)]
    faces = faces_of(np.eye(12, MODES), [40] * 12)
    cohort = cohort_of(faces, subject=subject, side=values)
    with pytest.raises(InputError, match=said):
        face_model(cohort, adjust=["side"], rng=np.random.default_rng(0))


def test_face_model__refuses_copies_of_one_subject():
    faces = np.repeat(faces_of(np.zeros((1, MODES)), [40]), 6, axis=0)
    with pytest.raises(InputError, match="needs 5 subjects who differ"):
        face_model(cohort_of(faces), rng=np.random.default_rng(0))


def test_face_model__names_subjects_without_an_attribute():
    ages = [np.nan, *range(30, 39)]
    faces = faces_of(np.random.default_rng(0).normal(size=(10, MODES)), [40] * 10)
    model = face_model(
        cohort_of(faces, age=ages), adjust=["age"], rng=np.random.default_rng(0)
    )
    assert model.sizes["subject"] == 9
    assert model.attrs["skipped"] == [{"take": "T0", "reason": "lacks age"}]
    height = [1.7, 1.8, *[np.nan] * 8]
    cohort = cohort_of(faces, age=[np.nan] * 2 + ages[:-2], height=height)
    with pytest.raises(InputError, match="must have age and height; found none"):
        face_model(cohort, adjust=["age", "height"], rng=np.random.default_rng(0))


def test_reconstruction_error__equals_that_of_a_loop():
    """Regression and modes of the others by a singular value decomposition."""
    cohort, _ = population(n=9, seed=2)
    model = face_model(cohort, k=4, adjust=["age"], rng=np.random.default_rng(0))
    vectors = np.stack([face_vector(cohort.isel(take=i)).values for i in range(9)])
    vectors = vectors.reshape(9, 10, -1)
    vectors[:, :3] = aligned(vectors[:, :3])
    ages = cohort["age"].values
    squares = np.zeros((9, 5, 4))
    for i in range(9):
        others = np.arange(9) != i
        design = np.column_stack([np.ones(8), ages[others]])
        coefficients = np.linalg.lstsq(design, vectors[others].reshape(8, -1))[0]
        rest = vectors[others].reshape(8, -1) - design @ coefficients
        rest = rest.reshape(8, 10, -1)
        apart = vectors[i] - (np.array([1, ages[i]]) @ coefficients).reshape(10, -1)
        scale = np.ones((10, 1))
        for rows in BLOCKS.values():
            scale[rows] = np.sqrt((rest[:, rows] ** 2).sum() / (8 - 2))
        axes = np.linalg.svd((rest / scale).reshape(8, -1), full_matrices=False)[2]
        scaled = (apart / scale).ravel()
        for count in range(5):
            part = axes[:count].T @ (axes[:count] @ scaled)
            error = (scaled - part).reshape(10, -1) * scale
            for j, rows in enumerate(BLOCKS.values()):
                channels = 1 if j == 0 else rows.stop - rows.start
                squares[i, count, j] = (error[rows] ** 2).sum() / (SIDE**2 * channels)
    np.testing.assert_allclose(
        model["reconstruction_error"], np.sqrt(squares.mean(axis=0)), rtol=1e-5
    )


def aligned(shapes):
    """Procrustes alignment by the SVD of the cross-covariance."""
    mean = shapes[0]
    for _ in range(10):
        moved = []
        target = mean - mean.mean(axis=1, keepdims=True)
        for shape in shapes:
            centred = shape - shape.mean(axis=1, keepdims=True)
            left, _, right = np.linalg.svd(target @ centred.T)
            flip = np.diag([1, 1, np.linalg.det(left @ right)])
            moved.append(left @ flip @ right @ centred)
        shapes = np.stack(moved)
        mean = shapes.mean(axis=0)
    return shapes


def test_face_model__takes_of_a_subject_count_once_and_others_are_left_out():
    cohort, _ = population(n=12)
    subject = ["T0", "T0", *(f"T{i}" for i in range(2, 12))]
    condition = ["normal"] * 11 + ["lotion"]
    age = cohort["age"].values.copy()
    age[5] = np.nan
    cohort = cohort_of(
        [face_vector(cohort.isel(take=i)).values for i in range(12)],
        subject=subject,
        condition=condition,
        age=age,
    )
    found = face_model(cohort, k=20, adjust=["age"], rng=np.random.default_rng(0))
    assert found["subject"].values.tolist() == [
        f"T{i}" for i in (0, 2, 3, 4, 6, 7, 8, 9, 10)
    ]
    assert found.sizes["mode"] == 9 - 2 - 1
    vectors = [face_vector(cohort.isel(take=i)).values[3:] for i in range(12)]
    faces = [
        (vectors[0] + vectors[1]) / 2,
        *(vectors[i] for i in (2, 3, 4, *range(6, 11))),
    ]
    np.testing.assert_allclose(
        found["face_mean"][3:], np.mean(faces, axis=0), rtol=1e-4
    )
    assert "fewer than 20 subjects" in " ".join(describe_face_model(found))
    with pytest.raises(InputError, match="needs 5 subjects"):
        face_model(cohort.isel(take=slice(0, 5)), rng=np.random.default_rng(0))


def test_privacy__a_mode_of_one_subject_is_named():
    vectors = faces_of(np.random.default_rng(0).normal(size=(24, MODES)), [40] * 24)
    vectors[3] += 2 * SPREAD * np.random.default_rng(1).normal(size=vectors[3].shape)
    found = face_model(cohort_of(vectors), k=3, rng=np.random.default_rng(0))
    assert float(found["mode_largest_subject"].max()) > 0.5
    assert any("privacy" in line for line in describe_face_model(found))


def test_samples__have_the_modes_and_keep_their_distance(model):
    faces = sample_faces(model, rng=np.random.default_rng(0), count=200, age=30)
    values = np.log(faces["texel_diffuse_reflectance"].values)
    wanted = face_vector(face_at(model, age=30)).values[3:6]
    spread = np.sqrt((model["face_mode"].values[:, 3:6] ** 2).sum(axis=0))
    error = (values.mean(axis=0) - np.moveaxis(wanted, 0, -1)) / np.moveaxis(
        spread, 0, -1
    )
    # a mean of 200 in each of two modes, beyond which one in 1e5 lies
    assert np.abs(error).max() < 4.8 / np.sqrt(200)
    # normal samples are as far from subjects as these are from each other
    assert model.attrs["nearest_subject"] == pytest.approx(1, abs=0.3)
    assert not any("privacy" in line for line in describe_face_model(model))
    with pytest.raises(InputError, match="choose from age"):
        face_at(model, weight=70)


def test_table_and_plot(model, tmp_path):
    header, rows = tabulate_face_model(model)
    assert header == [
        "mode",
        "mode_largest_subject",
        "variance_ratio",
        "shape_error",
        "albedo_error",
        "gloss_error",
        "translucency_error",
    ]
    assert len(rows) == MODES
    errors = model["reconstruction_error"].values
    assert rows[-1][3:] == errors[-1].tolist()
    assert (errors[-1] < errors[0]).all()
    figure = plot_face_model(model)
    figure.savefig(tmp_path / "modes.png")
    assert [ax.get_title() for ax in figure.axes[:3]] == ["-2 SD", "mean", "+2 SD"]


def read_npz(path):
    return dict(np.load(path))


def read_hdf5(path):
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(path) as file:
        names = []
        file.visititems(
            lambda name, item: names.append(name) if hasattr(item, "shape") else None
        )
        for group in file.values():
            assert group["representer"].attrs["datasetType"] == "POLYGON_MESH"
        return {name: file[name][()] for name in names}


@pytest.mark.parametrize(("name", "read"), [("m.npz", read_npz), ("m.h5", read_hdf5)])
def test_write__other_programs_rebuild_the_mean_and_a_step(model, tmp_path, name, read):
    """As scalismo and the scripts of AlbedoMM read it: mean + basis sqrt(variance) score."""
    if name == "m.h5":
        pytest.importorskip("h5py", reason="h5py is not installed")
    write_face_model(model, tmp_path / name)
    file = read(tmp_path / name)
    step = 0.01  # standard deviations: albedo is linear to first order
    wanted = face_at(model, [0, step])
    for group, variable in (
        ("shape", "texel_surfel_position"),
        ("diffuseAlbedo", "texel_diffuse_reflectance"),
        ("specularAlbedo", "texel_surface_reflectance"),
        ("translucency", "texel_sigma_tr"),
    ):
        basis = file[f"{group}/model/pcaBasis"]
        assert basis.shape == (3 * SIDE**2, MODES)
        np.testing.assert_allclose((basis**2).sum(axis=0), 1, rtol=1e-5)
        change = basis[:, 1] * np.sqrt(file[f"{group}/model/pcaVariance"][1]) * step
        values = (file[f"{group}/model/mean"] + change).reshape(SIDE, SIDE, 3)
        truth = wanted[variable].values
        truth = truth if truth.ndim == 3 else truth[..., None]
        # single precision, and the second order of a step of 0.01
        np.testing.assert_allclose(
            values, np.broadcast_to(truth, values.shape), rtol=3e-5, atol=1e-5
        )
        points = file[f"{group}/representer/points"]
        cells = file[f"{group}/representer/cells"]
        assert points.shape == (3, SIDE**2)
        assert cells.shape == (3, 2 * (SIDE - 1) ** 2)
        a, b, c = (points[:, ids].T for ids in cells)
        assert (np.cross(b - a, c - a)[:, 2] > 0).all()  # outwards
        assert file[f"{group}/model/noiseVariance"].shape == (1,)
    assert (tmp_path / name).stat().st_mode & 0o77 == 0


def test_face_model__without_a_probe_has_no_translucency():
    cohort, _ = population(n=8)
    cohort["texel_sigma_tr"][2] = np.nan
    found = face_model(cohort, rng=np.random.default_rng(0))
    assert found["block"].values.tolist() == ["shape", "albedo", "gloss"]

"""Fits, rows and shading of mixtures against plain NumPy, and on extreme samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import nnls
from three_surfels import (
    ETA,
    MATTE,
    SCALES,
    WEIGHT,
    rows_and_targets,
    six_materials,
    six_tables,
    surfels,
)

from skindb.fit.surface import NOISE_FLOOR_SURFACE
from skindb.optics.angles import half_difference
from skindb.reflectance import _lumitexel_kernels, _row_kernels
from skindb.reflectance._lumitexel_kernels import MIN_SAMPLES_GLOSS
from skindb.reflectance.dictionary import convolve_disc, embedded_dictionary
from skindb.reflectance.mixture import Mixture, basis_rows
from skindb.reflectance.model import Comparison, Lamp, Points
from skindb.reflectance.reduction import reduce_dictionary
from skindb.reflectance.tables import DEFAULT_GRID, TableGrid, lookup
from skindb.schema import FitStatus
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D

HALF = 1e-3  # samples are rounded to 5e-4
# positions in a table to 1e-6, times the slope of its lobes
SINGLE = 1e-4

each_mode = pytest.mark.parametrize("mode", ["linear", "perceptual"])


def _fit(skin, mode="linear", model=None, **options):
    comparison = Comparison(mode, ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES_GLOSS)
    model = model or six_materials()
    return model.fit(skin.block, comparison._replace(**options))


@each_mode
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [("float16", HALF), pytest.param("float32", SINGLE, marks=pytest.mark.slow)],
)
def test_fit__2400_samples_give_the_planted_reflectance(mode, dtype, tolerance):
    skin = surfels(150, 16, dtype=dtype)
    fit = _fit(skin, mode)
    assert (fit.status == FitStatus.FITTED).all()
    assert (fit.samples == 2400).all()
    assert fit.residual.max() < tolerance
    for s in range(3):
        M, _ = rows_and_targets(skin, s)
        expected = M @ WEIGHT
        np.testing.assert_allclose(
            M @ fit.parameters[s], expected, atol=tolerance * expected.max()
        )


def test_fit__few_samples_are_refused_or_fitted_no_worse_than_scipy():
    assert (_fit(surfels(2, 1)).status == FitStatus.TOO_FEW_SAMPLES).all()
    for lights in (3, 5):
        skin = surfels(lights, 1)
        # channels disagree
        skin = replace(skin, sample=skin.sample * np.float16([0.9, 1, 1.1]))
        refused = _fit(skin, min_samples=6)
        assert (refused.status == FitStatus.LAMBERT).all()
        assert np.isnan(refused.parameters).all()
        fit = _fit(skin, min_samples=1)
        for s in range(3):
            M, target = rows_and_targets(skin, s)
            reference = nnls(np.repeat(M, 3, 0), target.ravel())[1]
            residual = np.linalg.norm((M @ fit.parameters[s])[:, None] - target)
            assert residual <= reference + SINGLE * np.linalg.norm(target)


def _nan_in(name):
    skin = surfels()
    values = getattr(skin, name).copy()
    values[0] = np.nan
    return replace(skin, **{name: values})


@pytest.mark.parametrize(
    ("skin", "status"),
    [
        (lambda: surfels().filled(np.nan), FitStatus.UNSEEN),
        (lambda: surfels().spoiled(np.inf), FitStatus.NOT_FINITE),
        (lambda: surfels().spoiled(-np.inf), FitStatus.NOT_FINITE),
        (lambda: _nan_in("position"), FitStatus.NOT_FINITE),
        (lambda: _nan_in("normal"), FitStatus.UNDETERMINED),
        (lambda: _nan_in("diffuse"), FitStatus.NO_DIFFUSE_ESTIMATE),
    ],
    ids=["all saturated", "inf", "-inf", "position", "normal", "diffuse"],
)
@each_mode
def test_fit__a_broken_surfel_has_a_status_and_leaves_the_others_alone(
    skin, status, mode
):
    fit = _fit(skin(), mode)
    assert fit.status.tolist() == [status, FitStatus.FITTED, FitStatus.FITTED]
    assert np.isnan(fit.parameters[0]).all()
    assert np.isnan(fit.residual[0])
    np.testing.assert_array_equal(
        fit.parameters[1:], _fit(surfels(), mode).parameters[1:]
    )


def test_fit__a_sample_without_one_channel_is_excluded():
    fit = _fit(surfels().spoiled(np.nan))
    assert fit.samples.tolist() == [239, 240, 240]
    assert fit.residual.max() < HALF


@each_mode
def test_fit__black_samples_have_no_weight(mode):
    fit = _fit(surfels().filled(0.0), mode)
    assert fit.status[0] == FitStatus.FITTED
    assert (fit.parameters[0] == 0).all()


@pytest.mark.parametrize("eta", [1.0, 1.3, 1.5])
def test_fit__matte_skin_has_no_weight(eta):
    fit = _fit(surfels(eta=eta, weight=MATTE), eta=eta)
    assert fit.residual.max() < HALF
    assert np.abs(fit.parameters).max() < HALF


def test_fit__clamped_diffuse_reflectance_is_flagged():
    for value in (SMALLEST_R_D, LARGEST_R_D):
        diffuse = surfels().diffuse.astype(np.float32)  # as it is stored
        diffuse[0] = value
        fit = _fit(replace(surfels(), diffuse=diffuse))
        assert fit.status.tolist() == [FitStatus.DIFFUSE_CLAMPED, 0, 0]
        assert np.isfinite(fit.parameters).all()
        assert (fit.parameters >= 0).all()


def test_fit__lights_behind_and_near_the_horizon_do_not_count():
    upright = replace(
        surfels(), normal=np.tile([0.0, 0, 1], (3, 1)), position=np.zeros((3, 3))
    )
    expected = _fit(upright).parameters
    low = [[np.cos(a), np.sin(a), 0.05] for a in (0.1, 2.0, 4.0)]
    behind = [[0.0, 0, -1], [0.1, 0, -1]]
    for lights in (low, behind):
        fit = _fit(upright.with_lights(900 * np.array(lights), 50.0))
        np.testing.assert_allclose(fit.parameters, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_fit__half_floats_have_the_same_reflectance_in_any_precision(dtype):
    skin = surfels()
    expected = _fit(skin).parameters
    fit = _fit(replace(skin, sample=skin.sample.astype(dtype)))
    # only the mixed reflectance is determined, not the weights of similar materials
    for s in range(3):
        M, _ = rows_and_targets(skin, s)
        np.testing.assert_allclose(
            M @ fit.parameters[s],
            M @ expected[s],
            atol=1e-5 * np.abs(M @ WEIGHT).max(),
        )


@pytest.mark.parametrize("kind", ["zero", "duplicate", "collinear"])
def test_fit__redundant_tables(kind):
    six = six_tables()
    extra = {
        "zero": 0 * six[..., :1],
        "duplicate": six[..., :1],
        "collinear": six[..., :1] + six[..., 1:2],
    }[kind]
    fit = _fit(surfels(), model=Mixture(np.concatenate([extra, six, extra], axis=-1)))
    assert (fit.status == FitStatus.FITTED).all()
    assert fit.kkt.max() < 1e-9
    assert fit.residual.max() < HALF
    if kind == "zero":
        assert (fit.parameters[:, [0, 7]] == 0).all()


def test_fit__a_rank_above_that_of_the_tables():
    skin = surfels()
    fit = _fit(skin, model=Mixture(*reduce_dictionary(six_tables(), 99)))
    np.testing.assert_allclose(fit.parameters, _fit(skin).parameters, rtol=1e-12)
    # six tables that are multiples of one, in a space of four dimensions
    multiples = six_tables()[..., :1] * np.geomspace(0.5, 4, 6, dtype=np.float32)
    model = Mixture(*reduce_dictionary(np.ascontiguousarray(multiples), 4))
    fit = _fit(surfels(weight=np.array([0.4, 0, 0, 0, 0, 0])), model=model)
    assert (fit.status == FitStatus.FITTED).all()
    assert fit.residual.max() < HALF


def test_fit__no_surfels():
    assert _fit(surfels().empty).parameters.shape == (0, 6)


def _basis(*weights):
    columns = [six_tables() @ weight.astype(np.float32) for weight in weights]
    return Mixture(np.stack(columns, axis=-1))


@each_mode
def test_fit__of_the_true_component_and_of_duplicates_and_black_ones(mode):
    fit = _fit(surfels(), mode, _basis(WEIGHT))
    np.testing.assert_allclose(fit.parameters, 1.0, rtol=HALF)
    assert fit.residual.max() < HALF
    fit = _fit(surfels(), mode, _basis(WEIGHT, WEIGHT, 0 * WEIGHT))
    np.testing.assert_allclose(fit.parameters[:, :2].sum(axis=1), 1.0, rtol=HALF)
    assert (fit.parameters[:, 2] == 0).all()
    assert (fit.status == FitStatus.FITTED).all()


def test_fit__weights_are_divided_by_the_scale_of_the_component():
    for scale in SCALES:
        fit = _fit(surfels(), model=_basis(WEIGHT * scale))
        np.testing.assert_allclose(fit.parameters * scale, 1.0, rtol=HALF)


# places in the table to 1e-7 of 30 cells, times the slope of random numbers
SINGLE_ROWS = 3e-5
ARCTAN = 6e-11  # largest error of the polynomial


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _upper(rng, shape):
    return _unit(rng.normal(size=(*shape, 3)) * [1, 1, 0.3] + [0, 0, 0.9])


def _scene(n=20, lights=9, cameras=5):
    rng = np.random.default_rng(4)
    around = _unit(rng.normal(size=(n, 3)) * 0.4 + [0, 0, 1])
    return (
        around,
        _upper(rng, (n, lights)),
        _upper(rng, (n, cameras)),
        rng.random((n, lights, cameras)) < 0.6,
    )


def test_basis_rows__reproduce_lookup_times_cosine():
    n, light, camera, usable = _scene()
    grid = TableGrid(30, 20, 9)  # random numbers: no symmetry hides a turned phi_d
    table = np.random.default_rng(8).uniform(0.1, 1, (30, 20, 9, 7)).astype(np.float32)
    rows, offsets, index = basis_rows(table, grid, n, light, camera, usable)
    s = np.repeat(np.arange(20), np.diff(offsets))
    wi = light[s, index[:, 0]]
    wo = camera[s, index[:, 1]]
    want = lookup(table, *half_difference(wi, wo, n[s])) * (n[s] * wi).sum(1)[:, None]
    np.testing.assert_allclose(rows, want, rtol=SINGLE_ROWS)
    assert rows.dtype == np.float32


def test_basis_rows__exactly_the_usable_samples_above_the_horizon_in_order():
    n, light, camera, usable = _scene()
    light[3, 2], n[7], camera[5, 1] = np.nan, np.nan, np.inf
    usable[11] = False
    _, offsets, index = basis_rows(
        embedded_dictionary().table[..., :1], DEFAULT_GRID, n, light, camera, usable
    )
    want = [
        (s, i, o)
        for s in range(20)
        for i in range(9)
        for o in range(5)
        if usable[s, i, o]
        and n[s] @ light[s, i] > 0
        and np.isfinite(camera[s, o]).all()
        and n[s] @ camera[s, o] > 0
    ]
    s = np.repeat(np.arange(20), np.diff(offsets))
    assert np.column_stack([s, index]).tolist() == [list(w) for w in want]


def test_basis_rows__reciprocal():
    """If light and camera are exchanged, the BRDF is the same and the cosine differs."""
    n, light, camera, _ = _scene(50, 1, 1)
    table = embedded_dictionary().table
    every = np.ones((50, 1, 1), bool)
    there, offsets, _ = basis_rows(table, DEFAULT_GRID, n, light, camera, every)
    back, _, _ = basis_rows(table, DEFAULT_GRID, n, camera, light, every)
    s = np.repeat(np.arange(50), np.diff(offsets))
    cos_i, cos_o = ((n[s] * d[s, 0]).sum(1)[:, None] for d in (light, camera))
    assert len(s) > 40
    np.testing.assert_allclose(there / cos_i, back / cos_o, rtol=1e-5)


def _row(table, wi, wo):
    up = np.array([[0.0, 0, 1]])
    usable = np.ones((1, 1, 1), bool)
    grid = TableGrid(*table.shape[:3])
    return basis_rows(table, grid, up, wi[None, None], wo[None, None], usable)[0]


def test_basis_rows__overhead_mirrored_and_grazing_directions():
    rng = np.random.default_rng(8)
    table = rng.uniform(0.1, 1, (24, 20, 8, 2)).astype(np.float32)
    table[0] = 1.0  # where the half vector is the normal
    up = np.array([0.0, 0, 1])
    # light, camera and normal coincide, so phi_d is undefined
    np.testing.assert_allclose(_row(table, up, up), [[1.0, 1.0]], rtol=1e-6)
    mirrored = _row(table, np.array([0.6, 0, 0.8]), np.array([-0.6, 0, 0.8]))
    np.testing.assert_allclose(mirrored, [[0.8, 0.8]], rtol=SINGLE_ROWS)
    for height in (1e-8, 1e-4, 0.02):
        wi = np.array([np.sqrt(1 - height**2), 0, height])
        wo = np.array([0.6, 0.0, 0.8])
        expected = lookup(table, *half_difference(wi, wo)) * height
        np.testing.assert_allclose(_row(table, wi, wo)[0], expected, rtol=1e-4)


@pytest.mark.parametrize("n", [0, 3])
def test_basis_rows__nothing_usable(n):
    table = embedded_dictionary().table[..., :4]
    shapes = np.zeros((n, 3)), np.zeros((n, 6, 3)), np.zeros((n, 2, 3))
    rows, offsets, index = basis_rows(
        table, DEFAULT_GRID, *shapes, np.ones((n, 6, 2), bool)
    )
    assert rows.shape == (0, 4)
    assert offsets.tolist() == [0] * (n + 1)
    assert index.shape == (0, 2)


def test_basis_rows__any_memory_order_and_precision():
    n, light, camera, usable = _scene()
    table = embedded_dictionary().table[..., :4]
    want = basis_rows(table, DEFAULT_GRID, n, light, camera, usable)
    got = basis_rows(
        np.asfortranarray(table),
        DEFAULT_GRID,
        np.asfortranarray(n),
        light,
        camera[:, :, ::1],
        usable,
    )
    for a, b in zip(got, want, strict=True):
        np.testing.assert_array_equal(a, b)


def test_basis_rows__grid_must_match():
    with pytest.raises(ValueError, match="must have the shape of the grid"):
        basis_rows(
            np.zeros((3, 3, 3, 1), np.float32),
            DEFAULT_GRID,
            *np.zeros((3, 1, 1, 3)),
            np.zeros((1, 1, 1), bool),
        )


def test_fill_rows__releases_the_interpreter_lock():
    assert _row_kernels.fill_rows.targetoptions["nogil"]


def test_fill_rows__a_broken_direction_reads_no_wild_address():
    """The public function excludes such samples, and the kernel itself forms no row for them."""
    table = np.ones((4, 5, 6, 2), np.float32)
    rows = np.zeros((4, 2), np.float32)
    normal = np.array([[0.0, 0, 1]])
    light = np.array([[[np.nan, 0, 1], [np.inf, 0, 1]]])
    every = np.ones((1, 2, 2), bool)
    index = np.zeros((4, 2), np.int32)
    _row_kernels.fill_rows(
        table, normal, light, light, every, np.array([0, 4]), rows, index
    )
    assert (rows == 0).all()


def test_arctangent__as_numpy():
    rng = np.random.default_rng(5)
    y = rng.uniform(0, 1, 2000) ** 4
    x = rng.uniform(-1, 1, 2000) ** 3
    y[:4], x[:4] = [0, 0, 0, 1], [0, 1, -1, 0]
    got = [_row_kernels._arctangent(a, b) for a, b in zip(y, x, strict=True)]
    np.testing.assert_allclose(got, np.arctan2(y, x), atol=ARCTAN)


def test_reduce_dictionary__sixteen_dimensions_hold_every_material():
    """Relative rms over pairs of directions above 6 degrees, as a dome takes them; 0.2
    % and 1.2 % measured for the materials; the lobes are kept.
    """
    dictionary = convolve_disc(embedded_dictionary(), 0.0142)
    reduced, lift = reduce_dictionary(dictionary.table, 16, exact=dictionary.exact)
    assert reduced.shape[-1] == 24
    np.testing.assert_array_equal(reduced[..., 16:], dictionary.table[..., 59:])
    a = _unit(np.random.default_rng(6).normal(size=(2, 8000, 3)))
    a[..., 2] = np.abs(a[..., 2])
    wi, wo = a[:, (a[..., 2] > 0.1).all(0)]
    angles = half_difference(wi, wo)
    want = lookup(dictionary.table, *angles) * wi[:, 2:]
    error = lookup(reduced, *angles) * wi[:, 2:] @ lift - want
    relative = np.linalg.norm(error, axis=0) / np.linalg.norm(want, axis=0)
    assert np.median(relative) < 0.008
    assert relative.max() < 0.03


def test_reduce_dictionary__full_rank_and_dependent_tables():
    table = np.random.default_rng(0).uniform(size=(6, 5, 4, 3)).astype(np.float32)
    same, eye = reduce_dictionary(table, 3)
    assert same is table
    np.testing.assert_array_equal(eye, np.eye(3))
    twice = np.concatenate(
        [table[..., :2], 7 * table[..., :2], np.zeros((6, 5, 4, 1), np.float32)],
        axis=-1,
    )
    reduced, lift = reduce_dictionary(twice, 2)
    np.testing.assert_allclose(reduced @ lift, twice, atol=1e-5)


def test_table_grid__nodes():
    grid = TableGrid(5, 3, 4)
    np.testing.assert_allclose(
        np.sqrt(grid.theta_h / (np.pi / 2)), [0, 0.25, 0.5, 0.75, 1]
    )
    np.testing.assert_allclose(grid.theta_d, [0, np.pi / 4, np.pi / 2])
    np.testing.assert_allclose(grid.phi_d, [0, np.pi / 4, np.pi / 2, 3 * np.pi / 4])


def test_to_roots__every_magnitude():
    y = np.concatenate(
        [-np.geomspace(1e-15, 1e15, 999), [0], np.geomspace(1e-15, 1e15, 999)]
    )
    q = np.empty(len(y), np.float32)
    floor = 1e-8
    _lumitexel_kernels.to_roots(y.astype(np.float32), np.float32(floor), q)
    np.testing.assert_allclose(q, np.cbrt(y**2 + floor**2) ** -1, rtol=1e-6)


def test_interpolate_rows__of_another_normal_and_a_factor():
    n, light, camera, usable = _scene()
    turned = _unit(n + 0.3 * np.random.default_rng(5).normal(size=n.shape))
    table = np.random.default_rng(8).uniform(0.1, 1, (30, 20, 9, 8)).astype(np.float32)
    gloss = np.random.default_rng(9).uniform(0.1, 1, (9, 5)).astype(np.float32)
    memory = _row_kernels.row_memory(9, 5)
    below = 0
    for s in range(len(n)):
        rows = np.empty((45, 8), np.float32)
        index = np.empty((45, 2), np.int32)
        count = _row_kernels.list_rows(
            n[s], light[s], camera[s], usable[s], gloss, memory, index
        )
        _row_kernels.interpolate_rows(table, turned[s], count, memory.way, memory, rows)
        wi = light[s, index[:count, 0]]
        wo = camera[s, index[:count, 1]]
        up = (wi @ turned[s] > 0) & (wo @ turned[s] > 0)
        angles = half_difference(wi, wo, np.broadcast_to(turned[s], wi.shape))
        factor = (wi @ turned[s]) * gloss[*index[:count].T]
        want = np.where(up[:, None], lookup(table, *angles) * factor[:, None], 0)
        np.testing.assert_allclose(rows[:count], want, rtol=SINGLE_ROWS)
        below += int((~up).sum())
    assert below > 10


SHADE_ETA = 1.3
FLOAT32 = 2e-6  # relative: tables and results are float32, eight corners are summed


def fresnel_by_snell(cosine: np.ndarray, eta: float) -> np.ndarray:
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    s = (cosine - eta * inside) / (cosine + eta * inside)
    p = (eta * cosine - inside) / (eta * cosine + inside)
    return 1 - (s**2 + p**2) / 2


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def table_value(
    table: np.ndarray, n: np.ndarray, wi: np.ndarray, wo: np.ndarray
) -> np.ndarray:
    """Rotates into the half-vector frame by explicit matrices, as Rusinkiewicz 1998 writes it."""
    h = unit(wi + wo)
    theta_h = np.arccos(np.clip(n @ h, -1, 1))
    z = n
    x = unit(h - (n @ h) * n)
    local = np.array([x, np.cross(z, x), z]) @ wi
    c = np.cos(-theta_h)
    s = np.sin(-theta_h)
    difference = np.array(
        [c * local[0] + s * local[2], local[1], -s * local[0] + c * local[2]]
    )
    theta_d = np.arccos(np.clip(difference[2], -1, 1))
    phi_d = np.mod(np.arctan2(difference[1], difference[0]), np.pi)
    wrapped = np.concatenate([table, table[:, :, :1]], axis=2)
    nodes = [
        np.linspace(0, 1, table.shape[0]),
        np.linspace(0, np.pi / 2, table.shape[1]),
    ]
    phi = np.linspace(0, np.pi, table.shape[2] + 1)
    look = RegularGridInterpolator((*nodes, phi), wrapped.astype(np.float64))
    return look([np.sqrt(theta_h / (np.pi / 2)), theta_d, phi_d])[0]


@pytest.fixture
def points() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    n = 60
    k = 3
    lamps = 2
    normal = unit(rng.normal(size=(n, 3)))
    return {
        "position": rng.normal(size=(n, 3)) * 50,
        "normal": normal,
        "view": unit(normal + 0.8 * rng.normal(size=(n, 3))),
        "diffuse": rng.uniform(0.1, 0.9, (n, 3)),
        "weight": rng.uniform(0, 1, (n, k)) * (rng.random((n, k)) > 0.2),
        "table": rng.uniform(0.1, 1, (7, 6, 5, k)).astype(np.float32),
        "lamp": normal[:, None] * 800 + rng.normal(size=(n, lamps, 3)) * 500,
        "lit": rng.uniform(0, 1, (n, lamps)).astype(np.float32)
        * (rng.random((n, lamps)) > 0.2),
    }


def shaded(
    position, normal, view, diffuse, weight, table, *, lamp, lit, axis, falloff, eta
):
    points = Points(position, normal, view, diffuse, weight)
    return Mixture(table).shade(points, Lamp(lamp, lit, axis, falloff), eta=eta)


def test_shade__equals_slow_twin(points: dict[str, np.ndarray]) -> None:
    axis = unit(np.array([0.3, -0.2, -1.0]))
    falloff = 1.5
    values = shaded(**points, axis=axis, falloff=falloff, eta=SHADE_ETA)
    for i, (x, n, wo) in enumerate(
        zip(points["position"], points["normal"], points["view"], strict=True)
    ):
        expected = np.zeros(3)
        for lamp, share in zip(points["lamp"][i], points["lit"][i], strict=True):
            d = np.linalg.norm(lamp - x)
            wi = (lamp - x) / d
            if share == 0 or wi @ n <= 0 or wo @ n <= 0:
                continue
            through = (
                fresnel_by_snell(wi @ n, SHADE_ETA)
                * fresnel_by_snell(wo @ n, SHADE_ETA)
                / np.pi
            )
            gloss = points["weight"][i] @ table_value(points["table"], n, wi, wo)
            received = share * (wi @ n) / d**2 * max(-axis @ wi, 0) ** falloff
            expected += received * (through * points["diffuse"][i] + gloss)
        np.testing.assert_allclose(values[i], expected / 2, rtol=FLOAT32, atol=1e-12)


def test_shade__mirror_at_normal_incidence_reads_the_first_node() -> None:
    table = np.zeros((5, 4, 3, 1), np.float32)
    table[0, 0] = 2.0
    up = np.array([[0.0, 0.0, 1.0]])
    values = shaded(
        np.zeros((1, 3)),
        up,
        up,
        np.zeros((1, 3)),
        np.ones((1, 1)),
        table,
        lamp=up[:, None] * 10,
        lit=np.ones((1, 1), np.float32),
        axis=-up[0],
        falloff=0,
        eta=SHADE_ETA,
    )
    np.testing.assert_allclose(values, 2.0 / 100, rtol=FLOAT32)


def test_shade__is_reciprocal(points: dict[str, np.ndarray]) -> None:
    # swapping light and camera directions changes the radiance only by the ratio of the cosines
    one = points | {
        "lamp": points["position"][:, None]
        + points["normal"][:, None]
        + points["view"][:, None]
    }
    one["lit"] = np.ones((60, 1), np.float32)
    there = one["lamp"][:, 0] - one["position"]
    back = one | {
        "view": unit(there),
        "lamp": one["position"][:, None] + 5 * points["view"][:, None],
    }
    axis = np.array([0.0, 0.0, -1.0])
    cos_i = np.einsum("nc,nc->n", unit(there), points["normal"])
    cos_o = np.einsum("nc,nc->n", points["view"], points["normal"])
    use = (cos_i > 0.01) & (cos_o > 0.01)
    forward = (
        shaded(**one, axis=axis, falloff=0, eta=SHADE_ETA)
        * np.sum(there**2, axis=1)[:, None]
        / cos_i[:, None]
    )
    backward = shaded(**back, axis=axis, falloff=0, eta=SHADE_ETA) * 25 / cos_o[:, None]
    np.testing.assert_allclose(forward[use], backward[use], rtol=5e-6)

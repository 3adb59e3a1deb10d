"""Detail at the texels of the atlas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.detail import PIXEL_MM, write_patch
from skindb.calibration._merge_kernels import DARK, OK
from skindb.fit import fit_model
from skindb.format.folder import read_capture
from skindb.ingest import ingest_capture
from skindb.ingest._detail_kernels import add_samples
from skindb.ingest.detail import BLUR_PIXELS, Detail
from skindb.ingest.surfels import build_surfels
from skindb.parameters import FitParameters
from skindb.render.photographs import compare_photographs
from skindb.types import unit


def test_add_samples__normal_equations_of_chosen_views():
    """Rationale: the least-squares solution by NumPy. Expected: the same up to single precision."""
    rng = np.random.default_rng(1)
    n = 7
    position = rng.normal(0, 20, (n, 3))
    normal = unit(rng.normal(0, 0.2, (n, 3)) + np.array([0, 0, 1]))
    lights = unit(rng.normal(0, 1, (40, 3)) + np.array([0, 0, 0.8])) * 800
    camera = np.array([100.0, 50, 700])
    sums = np.zeros((n, 15), np.float32)
    rows = []
    for light in lights:
        values = rng.uniform(0.05, 0.4, (3, n)).astype(np.float16)
        outcome = np.where(rng.random(n) < 0.8, OK, DARK).astype(np.uint8)
        bits = values.view(np.uint16)
        limits = (0.25, np.cos(0.35))
        add_samples(bits, outcome, position, normal, light, camera, *limits, sums)
        to_light, to_camera = unit(light - position), unit(camera - position)
        cosines = [(x * normal).sum(axis=1) for x in (to_light, to_camera)]
        half = (unit(to_light + to_camera) * normal).sum(axis=1)
        used = (outcome == OK) & (np.min(cosines, axis=0) >= 0.25)
        used &= half <= np.cos(0.35)
        rows.append((used, cosines[1], to_light, values.T.astype(float)))
    for i in range(n):
        chosen = [[x[i] for x in row[1:]] for row in rows if row[0][i]]
        weight, way, rho = (np.array(x) for x in zip(*chosen, strict=True))
        scale = weight[:, None]  # the root of the weight
        expected = np.linalg.lstsq(scale * way, scale * rho, rcond=None)[0]
        xx, xy, xz, yy, yz, zz = sums[i, :6]
        gram = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)
        solved = np.linalg.solve(gram, sums[i, 6:].reshape(3, 3))
        assert solved == pytest.approx(expected, rel=1e-4, abs=1e-5)


def sheet_detail(pattern: float, noise: float, seed: int, lights: int = 24):
    """True detail of a flat sheet with a random pattern of R_d, and the group."""
    rng = np.random.default_rng(seed)
    size, spacing = 128, 8
    lines = np.arange(0, size + 1, spacing) / size
    u, v = (a.ravel() for a in np.meshgrid(lines, lines))
    side = len(lines)
    true = gaussian_filter(rng.standard_normal((size, size)), 1.2, mode="wrap")
    true = 1 + pattern * true / true.std()
    shown = gaussian_filter(true, BLUR_PIXELS, mode="wrap")
    texel = np.arange(size * size)
    row, column = np.divmod(texel, size)
    cells = (column // spacing, row // spacing)
    x, y = ((a % spacing + 0.5) / spacing for a in (column, row))
    first = cells[1] * side + cells[0]
    # bilinear cells: their two triangles as one of three corners each
    low = x + y < 1
    corners = np.where(
        low[:, None],
        np.stack([first, first + 1, first + side], axis=1),
        np.stack([first + side + 1, first + side, first + 1], axis=1),
    )
    a, b = np.where(low, x, 1 - x), np.where(low, y, 1 - y)
    weight = np.stack([1 - a - b, a, b], axis=1)
    count = side * side
    surfel_rows = np.minimum((v * size).astype(int), size - 1)
    surfel_columns = np.minimum((u * size).astype(int), size - 1)
    at_surfels = shown[surfel_rows, surfel_columns]
    albedo = np.concatenate([shown.ravel(), at_surfels])
    corners = np.concatenate([corners, np.repeat(np.arange(count)[:, None], 3, 1)])
    weight = np.concatenate([weight, np.tile([1.0, 0, 0], (count, 1))])
    position = np.stack([u, 1 - v, 0 * u], axis=1)[corners] * 40
    position = (weight[..., None] * position).sum(axis=1)
    normal = np.tile([0.0, 0, 1], (len(position), 1))
    sums = np.zeros((2, len(position), 15), np.float32)
    weight = weight.astype(np.float32)
    detail = Detail(
        size, BLUR_PIXELS, texel, corners, weight, position, normal, (), sums
    )
    camera = np.array([0.0, 0, 800])
    for j, way in enumerate(
        unit(rng.normal(0, 1, (lights, 3)) * [1, 1, 0.3] + [0, 0, 1])
    ):
        towards = unit(800 * way - position)
        rho = (albedo * towards[:, 2])[:, None] * [0.18, 0.12, 0.08]
        rho = rho * (1 + noise * rng.standard_normal(rho.shape))
        bits = np.ascontiguousarray(rho.T.astype(np.float16)).view(np.uint16)
        detail.add(bits, np.full(len(position), OK, np.uint8), j, 800 * way, camera)
    smooth = (weight[: size**2] * at_surfels[corners[: size**2]]).sum(axis=1)
    expected = (true.ravel() / smooth - 1).reshape(size, size)
    return expected, detail.group()


def test_detail__recovers_a_pattern_within_its_errors():
    """Rationale: a pattern of 10 %, blurred as by pixels, with noise of 3 % in 24 views.
    Expected: at least 95 % of the texels within 1.96 errors, which are at most twice too
    large, and no tilt.
    """
    expected, group = sheet_detail(0.1, 0.03, 0)
    inner = (slice(4, -4), slice(4, -4))
    error = (
        group["diffuse_detail"].values.astype(float)[inner] - expected[inner][..., None]
    )
    stated = group["diffuse_detail_error"].values.astype(float)[inner]
    assert (np.abs(error) < 1.96 * stated).mean() > 0.95
    rms = np.sqrt((error**2).mean())
    assert 1.0 < np.sqrt((stated**2).mean()) / rms < 2.0
    # of 0.12; without what the blur took, the gain is 0.90 to 0.92
    estimate = group["diffuse_detail"].values.astype(float)[inner].mean(axis=-1)
    pattern = expected[inner]
    assert rms < 0.02
    assert (estimate * pattern).sum() / (pattern**2).sum() > 0.94
    tilt = group["normal_detail"].values.astype(float)[inner]
    # noise 0.03 of the mean channel in 24 views
    assert np.sqrt((tilt**2).mean()) < 0.01


def test_detail__shrinks_noise_to_nothing():
    """Rationale: an even sheet with noise. Expected: a tenth of the noise, which is
    3 % / sqrt(24) with the factor of lights from the side, remains.
    """
    _, group = sheet_detail(0.0, 0.03, 1)
    assert group["diffuse_detail"].values.astype(float).std() < 0.003


def test_detail__four_lights_do_not_determine_it():
    # two in each half
    assert sheet_detail(0.1, 0.0, 2, lights=4)[1] is None


def test_ingest_capture__detail_of_pores_and_wrinkles(tmp_path):
    """Rationale: a patch at 0.3 mm per pixel, and photographs that its detail was not made
    from. Expected: 0.85 of their fine contrast and more, in its place (0.5 without).
    """
    write_patch(tmp_path / "patch", side=21.0, lights=12, cameras=2)
    capture = read_capture(tmp_path / "patch")
    surfels = build_surfels(capture, spacing_mm=0.3)
    assert surfels.spacing() < 2 * PIXEL_MM
    assert Detail.of(surfels, capture.dome.cameras) is None
    with ingest_capture(capture, scratch=tmp_path) as tree:
        model = fit_model(tree, FitParameters(light_gains=False, k=4))
        assert model["detail"].identical(tree["detail"].compute())
        compared = compare_photographs(model, tree)
        del model["detail"]
        without = compare_photographs(model, tree)
    for fine, coarse in zip(compared, without, strict=True):
        assert fine.error["fine_gain"] > 0.85
        assert fine.error["fine_contrast"] < 1.05
        assert coarse.error["fine_gain"] < 0.5

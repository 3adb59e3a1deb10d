"""Compiled normals compared with plain code, one surfel at a time."""

from __future__ import annotations

import numpy as np

from skindb.optics._photometric_kernels import (
    NormalEstimates,
    buffers,
    estimate_normal,
    normal_estimates,
)
from skindb.optics.fresnel import fresnel_transmittance

ETA = 1.3
PRIOR = np.deg2rad(3.0)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _scene(seed, surfels=12, lights=40, cameras=7):
    """Glossy, shadowed, noisy points with holes; lights down to the horizon."""
    rng = np.random.default_rng(seed)
    normal = _unit(rng.normal(size=(surfels, 3)) * 0.3 + [0, 0, 1])
    position = 50 * normal
    light = 900 * _unit(rng.normal(size=(lights, 3)) * [1, 1, 0.5] + [0, 0, 0.6])
    camera = 800 * _unit(rng.normal(size=(cameras, 3)) * 0.7 + [0, 0, 1])
    wi = _unit(light - position[:, None])
    wo = _unit(camera - position[:, None])
    ci = np.einsum("nk,nlk->nl", normal, wi)
    co = np.einsum("nk,nck->nc", normal, wo)
    half = np.einsum("nk,nlck->nlc", normal, _unit(wi[:, :, None] + wo[:, None])).clip(
        0, 1
    )
    sample = (ci.clip(0)[:, :, None, None]) * (
        np.array([0.15, 0.1, 0.07]) + 0.2 * half[..., None] ** 30
    )
    sample *= (1 + 0.02 * rng.normal(size=sample.shape)) * np.where(
        rng.uniform(size=ci.shape) < 0.1, 0.3, 1
    )[:, :, None, None]
    sample[
        (rng.uniform(size=half.shape) < 0.15)
        | (ci <= 0)[:, :, None]
        | (co <= 0)[:, None]
    ] = np.nan
    scan = _unit(normal + 0.03 * rng.normal(size=normal.shape))
    return sample.astype(np.float32), position, light, camera, scan


def _estimates(sample, position, light, camera, scan):
    """Estimates of all surfels, with the surfel as the first axis."""
    memory = buffers(len(light), len(camera))
    out = []
    for s in range(len(sample)):
        out.append(normal_estimates())
        points = (position[s], light, camera, scan[s])
        estimate_normal(sample[s], *points, ETA, PRIOR, memory, out[s])
    return NormalEstimates(*(np.stack(arrays) for arrays in zip(*out, strict=True)))


def _directions(s, position, light, camera):
    return _unit(light - position[s]), _unit(camera - position[s])


def _naive_photometric(shade, to_light, scan):
    usable = np.isfinite(shade)
    normal = scan
    weight = usable * 1.0
    spread = 0.0
    size = 1.0
    for step in range(12):
        cosine = to_light @ normal
        lit = usable & (cosine > 0.1)
        row = (
            fresnel_transmittance(np.maximum(cosine, 0.1), ETA)[lit, None]
            * to_light[lit]
        )
        matrix = row.T @ (weight[lit, None] * row)
        if step:
            share = max(lit.sum() / 8, 1) * (spread / (size * PRIOR)) ** 2
            matrix += share * (np.eye(3) - np.outer(scan, scan))
        matrix += (1e-6 * np.trace(matrix) + 1e-12) * np.eye(3)
        g = np.linalg.solve(matrix, row.T @ (weight[lit] * shade[lit]))
        size = np.linalg.norm(g)
        normal = g / size
        residual = shade[lit] - row @ g
        spread = 1.4826 * np.median(abs(residual)) + 0.01 * size
        weight = np.ones(len(shade))
        weight[lit] = np.clip(1 - (residual / (4.685 * spread)) ** 2, 0, 1) ** 2
    return normal, spread / size


def test_estimate_normals__are_those_of_the_plain_rule():
    for seed in [0, 1, 2]:
        sample, position, light, camera, scan = _scene(seed)
        found = _estimates(sample, position, light, camera, scan)
        for s in range(len(sample)):
            to_light, to_camera = _directions(s, position, light, camera)
            seen = to_camera @ scan[s] > 0.2
            part = sample[s][:, seen].astype(np.float64)
            part[~np.isfinite(part).all(-1)] = np.nan
            through = fresnel_transmittance(to_camera[seen] @ scan[s], ETA)
            colour = np.nanmean(part, axis=(0, 1))
            tint = _unit(colour - colour.mean())
            white = np.full(len(part), np.nan)
            tinted = np.full(len(part), np.nan)
            for i in range(len(part)):
                known = np.isfinite(part[i]).all(-1)
                if known.any():
                    shades = np.sort(part[i, known].mean(-1) / through[known])
                    white[i] = shades[int(np.rint(0.25 * (known.sum() - 1)))]
                    tinted[i] = np.median(part[i, known] @ tint / through[known])
            for q, shade in enumerate((white, tinted)):
                normal, spread = _naive_photometric(shade, to_light, scan[s])
                # the kernel stops when a step turns the normal by less than 3e-5 rad;
                # the next ones are shorter
                np.testing.assert_allclose(found.normal[s, q], normal, atol=1e-4)
                np.testing.assert_allclose(found.spread[s, q], spread, rtol=2e-3)


def test_estimate_normals__covariance_is_the_scatter_of_repeated_draws():
    rng = np.random.default_rng(5)
    _, position, light, camera, scan = _scene(6, surfels=1, lights=60, cameras=1)
    to_light, to_camera = _directions(0, position, light, camera)
    cosine = (to_light @ scan[0]).clip(0)
    shade = (
        cosine
        * fresnel_transmittance(cosine, ETA)
        * fresnel_transmittance(to_camera @ scan[0], ETA)
    )
    draws = 800
    clean = shade[:, None, None] * np.array([0.15, 0.1, 0.07])
    sample = clean * (1 + 0.05 * rng.normal(size=(draws, *clean.shape)))
    sample[:, cosine <= 0] = np.nan
    points = (np.repeat(a, draws, axis=0) for a in (position, scan))
    place, scans = points
    found = _estimates(sample.astype(np.float32), place, light, camera, scans)
    for q in range(2):
        scatter = np.trace(np.cov(found.normal[:, q].T))
        # 800 draws give a variance to 5 %; the linear model neglects that F_t decreases
        # towards grazing light, which also determines the normal: a third too large
        # here
        assert 0.8 < np.einsum("nkk->n", found.covariance[:, q]).mean() / scatter < 1.5


def test_estimate_normals__pull_is_the_derivative_by_the_scan():
    sample, position, light, camera, scan = _scene(7, lights=4, surfels=30)
    turn = np.cross(scan, [0.0, 1.0, 0.0]) * 0.002
    found, moved = (
        _estimates(sample, position, light, camera, _unit(scan + d)) for d in (0, turn)
    )
    step = moved.normal[:, 0] - found.normal[:, 0]
    expected = np.einsum("njk,nk->nj", found.pull[:, 0], turn)
    size = np.linalg.norm(turn, axis=1)
    error = np.linalg.norm(step - expected, axis=1) / size
    # robust weights and lights at the horizon depend on the scan too, which does not
    # affect the median surfel
    assert np.median(error) < 0.15
    assert np.median(np.linalg.norm(step, axis=1) / size) > 0.3

"""Angles, tables, rows and dictionary against definitions and slow twins."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.errors import InputError
from skindb.optics.abc_low2012 import PARAMETERS
from skindb.optics.angles import directions, half_difference
from skindb.optics.brdf_table import DEFAULT_GRID, TableGrid, directional_albedo, lookup, tabulate
from skindb.optics.dictionary import convolve_disc, embedded_dictionary, evaluate_abc, read_merl_folder
from skindb.optics.merl import SHAPE, read_merl, write_merl
from skindb.optics.rows import basis_rows, reduce_dictionary

ROWS = np.array(list(PARAMETERS.values()))
FLOAT32 = 2e-6  # relative rounding of a float32 sum of eight products


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _upper(rng, shape):
    return _unit(rng.normal(size=(*shape, 3)) * [1, 1, 0.3] + [0, 0, 0.9])


def test_half_difference__by_definition():
    rng = np.random.default_rng(0)
    wi, wo = _upper(rng, (500,)), _upper(rng, (500,))
    th, td, pd = half_difference(wi, wo)
    h = _unit(wi + wo)
    np.testing.assert_allclose(np.cos(th), h[:, 2], atol=1e-12)
    np.testing.assert_allclose(np.cos(td), (wi * h).sum(1), atol=1e-12)
    # the elevations follow from the angles, up to the exchange of the two directions
    z = [np.cos(th) * np.cos(td) + q * np.sin(th) * np.sin(td) * np.cos(pd) for q in (-1, 1)]
    np.testing.assert_allclose(np.sort(z, axis=0), np.sort([wi[:, 2], wo[:, 2]], axis=0), atol=1e-9)
    assert ((pd >= 0) & (pd < np.pi)).all()


def test_half_difference__reciprocal_and_turned_with_the_normal():
    rng = np.random.default_rng(1)
    wi, wo = _upper(rng, (200,)), _upper(rng, (200,))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    here = half_difference(wi, wo)
    there = half_difference(wo @ turn.T, wi @ turn.T, np.broadcast_to(turn[:, 2], wi.shape))
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(np.cos(2 * a), np.cos(2 * b), atol=1e-9)


def test_directions__invert_the_angles():
    rng = np.random.default_rng(2)
    th, td, pd = rng.uniform(0.01, 0.7, 100), rng.uniform(0.01, 0.7, 100), rng.uniform(0.01, 3.1, 100)
    for got, want in zip(half_difference(*directions(th, td, pd)), (th, td, pd), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-9)


def test_lookup__exact_at_nodes_and_periodic():
    grid = TableGrid(12, 10, 8)
    table = np.random.default_rng(0).uniform(size=(12, 10, 8, 3))
    mesh = np.meshgrid(grid.theta_h, grid.theta_d, grid.phi_d, indexing="ij")
    np.testing.assert_allclose(lookup(table, *mesh), table, atol=1e-12)
    np.testing.assert_allclose(lookup(table, mesh[0], mesh[1], mesh[2] + np.pi), table, atol=1e-12)


def test_embedded_dictionary__trilinear_error_is_small():
    """1.3 % rms above 6 degrees of elevation, weighted by the two cosines: measured, with a margin of a third."""
    rng = np.random.default_rng(0)
    wi, wo = directions(rng.random(20000) ** 2 * np.pi / 2, rng.random(20000) * np.pi / 2, rng.random(20000) * np.pi)
    up = (wi[:, 2] > 0.1) & (wo[:, 2] > 0.1)
    exact = evaluate_abc(ROWS, wi[up], wo[up])
    table = lookup(embedded_dictionary().table, *half_difference(wi[up], wo[up]))
    weight = (wi[up, 2] * wo[up, 2])[:, None]
    rms = np.sqrt((weight * (table - exact) ** 2).sum(0) / (weight * exact**2).sum(0))
    assert np.median(rms) < 0.017
    assert rms.max() < 0.04


def test_embedded_dictionary__fifty_nine_physical_materials():
    dictionary = embedded_dictionary()
    assert len(dictionary.names) == 59
    assert (dictionary.table >= 0).all()
    albedo = directional_albedo(dictionary.table, [1.0, 0.7, 0.4])
    assert (albedo < 1).all()
    assert (albedo > 0).all()


def test_directional_albedo__lambertian():
    table = np.full((90, 120, 16, 1), 0.5 / np.pi)
    np.testing.assert_allclose(directional_albedo(table, [1.0, 0.5]), 0.5, rtol=5e-3)  # the horizon cuts cells


def test_convolve_disc__matches_averaging_of_the_exact_model():
    """Away from the horizon: the average over a dense disc around either direction, as in the docstring."""
    radius, rng = 0.0142, np.random.default_rng(3)
    wi, wo = directions(rng.random(300) ** 2 * 0.8, rng.random(300) * 0.8, rng.random(300) * np.pi)
    k = np.arange(400)
    disc = (
        np.sqrt((k + 0.5) / 400)[:, None] * np.stack([np.cos(k * 2.399963), np.sin(k * 2.399963)], 1) * np.tan(radius)
    )
    total = np.zeros((300, 59))
    for a, b in ((wi, wo), (wo, wi)):
        first = _unit(np.cross(a, [0.3, 0.9, 0.1]))
        second = np.cross(a, first)
        for u, v in disc:
            total += evaluate_abc(ROWS, _unit(a + u * first + v * second), b) / 800
    table = convolve_disc(embedded_dictionary(), radius).table
    got = lookup(table, *half_difference(wi, wo))
    rms = np.sqrt(((got - total) ** 2).sum(0) / (total**2).sum(0))
    assert np.median(rms) < 0.001  # measured 6.5e-4
    assert rms.max() < 0.05  # 3.4 % for the sharpest lobe, which is as narrow as the disc


def test_basis_rows__reproduce_lookup_times_cosine():
    rng = np.random.default_rng(4)
    n, light, camera = _upper(rng, (20,)), _upper(rng, (20, 9)), _upper(rng, (20, 5))
    usable = rng.random((20, 9, 5)) < 0.6
    light[3, 2] = np.nan
    n[7] = np.nan
    table = embedded_dictionary().table[..., :7]
    rows, offsets, index = basis_rows(table, DEFAULT_GRID, n, light, camera, usable)
    s = np.repeat(np.arange(20), np.diff(offsets))
    wi, wo = light[s, index[:, 0]], camera[s, index[:, 1]]
    cosine = (n[s] * wi).sum(1)
    want = lookup(table, *half_difference(wi, wo, n[s])) * cosine[:, None]
    np.testing.assert_allclose(rows, want, rtol=FLOAT32 * 50, atol=FLOAT32 * np.abs(want).max())
    assert (cosine > 0).all()
    assert 7 not in s
    assert len(rows) == sum(
        usable[i, j, k] and n[i] @ light[i, j] > 0 and n[i] @ camera[i, k] > 0
        for i in range(20) for j in range(9) for k in range(5)
    )  # fmt: skip


def test_basis_rows__grid_must_match():
    with pytest.raises(ValueError, match="does not lie on the grid"):
        basis_rows(np.zeros((3, 3, 3, 1), np.float32), DEFAULT_GRID, *np.zeros((3, 1, 1, 3)), np.zeros((1, 1, 1), bool))


def test_reduce_dictionary__sixteen_dimensions_hold_the_tables():
    table = convolve_disc(embedded_dictionary(), 0.0142).table
    reduced, lift = reduce_dictionary(table, 16)
    assert reduced.shape[-1] == 16
    error = np.linalg.norm(reduced @ lift.astype(np.float32) - table) / np.linalg.norm(table)
    assert error < 0.002  # measured 1.4e-4
    same, eye = reduce_dictionary(table, 59)
    assert same is table
    np.testing.assert_array_equal(eye, np.eye(59))


def test_merl__round_trip_holes_and_damage(tmp_path):
    table = np.random.default_rng(0).uniform(0, 2, (*SHAPE, 3))
    write_merl(tmp_path / "a.binary", table)
    got, holes = read_merl(tmp_path / "a.binary")
    np.testing.assert_allclose(got, table, rtol=1e-14)
    assert holes == 0
    raw = bytearray((tmp_path / "a.binary").read_bytes())
    raw[12:20] = np.float64(-1.0).tobytes()
    (tmp_path / "a.binary").write_bytes(raw)
    got, holes = read_merl(tmp_path / "a.binary")
    assert holes == 1
    assert got[0, 0, 0, 0] == 0
    (tmp_path / "a.binary").write_bytes(raw[:1000])
    with pytest.raises(InputError, match="download it again"):
        read_merl(tmp_path / "a.binary")


def test_read_merl_folder__tables_of_a_known_brdf(tmp_path):
    centres = [(np.arange(90) + 0.5) ** 2 / 90**2 * np.pi / 2, (np.arange(90) + 0.5) * np.pi / 180]
    th, td, _ = np.meshgrid(*centres, np.zeros(180), indexing="ij")
    write_merl(tmp_path / "a.binary", np.repeat((np.exp(-4 * th) + 0.2 * td)[..., None], 3, axis=-1))
    dictionary = read_merl_folder(tmp_path)
    want = tabulate(lambda wi, wo: _known(*half_difference(wi, wo)), DEFAULT_GRID)
    middle = np.s_[5:80, 5:80]
    assert dictionary.names == ("a",)
    np.testing.assert_allclose(dictionary.table[middle], want[middle], rtol=0.01)
    with pytest.raises(InputError, match=r"none; give their folder"):
        read_merl_folder(tmp_path / "empty")


def _known(th, td, _):
    return (np.exp(-4 * th) + 0.2 * td)[..., None]

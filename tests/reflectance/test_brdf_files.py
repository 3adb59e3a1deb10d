"""Files of measured BRDFs: tables and MERL binaries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from skindb.errors import InputError
from skindb.optics.angles import half_difference
from skindb.reflectance.brdf_files import (
    SHAPE,
    read_dictionary,
    read_merl,
    read_merl_folder,
    read_tables,
    to_grid,
    write_merl,
    write_tables,
)
from skindb.reflectance.dictionary import Dictionary, convolve_disc
from skindb.reflectance.tables import DEFAULT_GRID, tabulate


def test_read_merl_folder__tables_of_a_known_brdf(tmp_path):
    centre = (np.arange(90) + 0.5) / 90
    th, td, pd = np.meshgrid(
        centre**2, centre, (np.arange(180) + 0.5) / 180, indexing="ij"
    )
    write_merl(
        tmp_path / "b.binary", np.repeat(_known(th, td, pd)[..., None], 3, axis=-1)
    )
    write_merl(tmp_path / "a.binary", np.ones((*SHAPE, 3)))
    dictionary = read_merl_folder(tmp_path)
    want = tabulate(
        lambda wi, wo: _known(*_shares(*half_difference(wi, wo)))[..., None],
        DEFAULT_GRID,
    )
    assert dictionary.names == ("a", "b")
    np.testing.assert_allclose(dictionary.table[..., 0], 1, rtol=1e-6)
    middle = np.s_[1:89, 1:119]  # the outermost nodes lie outside the bins' centres
    np.testing.assert_allclose(
        dictionary.table[..., 1][middle], want[..., 0][middle], rtol=0.005
    )


def _shares(th, td, pd):
    return th / (np.pi / 2), td / (np.pi / 2), pd / np.pi


def _known(th, td, pd):
    return np.exp(-4 * th) + 0.2 * td + 0.1 + 0.1 * np.cos(2 * np.pi * pd)


def test_read_merl_folder__holes_continue_their_neighbour(tmp_path):
    """Holes beyond a theta_d, before one, and in whole planes of theta_h; a negative
    channel makes a hole in all.
    """
    write_merl(tmp_path / "a.binary", np.ones((*SHAPE, 3)))
    raw = (
        np.frombuffer((tmp_path / "a.binary").read_bytes()[12:], "<f8")
        .reshape(3, *SHAPE)
        .copy()
    )
    raw[1, :, 60:, :90] = raw[0, :, :5, 90:] = raw[2, :3] = -1.0
    (tmp_path / "a.binary").write_bytes(
        np.array(SHAPE, "<i4").tobytes() + raw.tobytes()
    )
    np.testing.assert_allclose(read_merl_folder(tmp_path).table, 1, rtol=1e-6)


def test_read_merl_folder__a_measured_zero_stays(tmp_path):
    table = np.ones((*SHAPE, 3))
    table[:, 60:] = 0.0
    write_merl(tmp_path / "a.binary", table)
    assert read_merl_folder(tmp_path).table[:, -1].max() == 0


def test_read_merl_folder__all_damaged_files_at_once(tmp_path):
    with pytest.raises(InputError, match="none; choose their folder"):
        read_merl_folder(tmp_path)
    for name in ("a", "b"):
        (tmp_path / f"{name}.binary").write_bytes(b"short")
    with pytest.raises(InputError, match="download it again") as caught:
        read_merl_folder(tmp_path)
    assert [Path(fault.where).name for fault in caught.value.faults] == [
        "a.binary",
        "b.binary",
    ]


def test_read_merl_folder__counts_holes_above_the_horizon_only(tmp_path):
    """A tenth of the bins of phi_d, at every theta_h below 20 degrees and theta_d below
    45: all above the horizon.
    """
    write_merl(tmp_path / "a.binary", np.ones((*SHAPE, 3)))
    raw = (
        np.frombuffer((tmp_path / "a.binary").read_bytes()[12:], "<f8")
        .reshape(3, *SHAPE)
        .copy()
    )
    raw[:, :42, :45, ::10] = -1.0
    raw[:, 80:, 80:, :60] = -1.0  # wholly below it: tan tan cos > 1
    (tmp_path / "a.binary").write_bytes(
        np.array(SHAPE, "<i4").tobytes() + raw.tobytes()
    )
    found = read_merl_folder(tmp_path)
    centre = (np.arange(90) + 0.5) / 90
    th, td, pd = np.meshgrid(
        centre**2 * np.pi / 2,
        centre * np.pi / 2,
        (np.arange(180) + 0.5) / 180 * np.pi,
        indexing="ij",
    )
    tilt = np.abs(np.sin(th) * np.sin(td) * np.cos(pd))  # cosines are cos cos -+ this
    above = (np.cos(th) * np.cos(td) > tilt).sum()
    assert found.origins[0].hole_fraction == pytest.approx(
        42 * 45 * 18 / above, rel=1e-6
    )
    assert found.notes[0].startswith(
        "materials with unmeasured nodes above the horizon: 1, most in a ("
    )


def _nodes():
    return {
        "theta_h": np.linspace(0, 1, 40) ** 2 * np.pi / 2,
        "theta_d": np.linspace(0, 1, 50) ** 1.2 * np.pi / 2,
        "phi_d": (np.arange(12) + 0.3) / 12 * np.pi,
    }


def _file(path, **change):
    """An .npz of two materials, `change` in place of its arrays (None: without)."""
    mesh = np.meshgrid(*_nodes().values(), indexing="ij")
    brdf = 0.2 * np.stack([_known(*_shares(*mesh)), np.ones(mesh[0].shape)])
    arrays = {
        "basis_brdf": brdf,
        "names": np.array(["known", "flat"]),
        **_nodes(),
    } | change
    np.savez(
        path, **{name: value for name, value in arrays.items() if value is not None}
    )
    return path


def test_resample__linear_in_the_tables_coordinates():
    """Random values at uneven nodes against SciPy over three periods of phi_d; the
    outermost values hold beyond.
    """
    rng = np.random.default_rng(4)
    h, d, p = (np.sort(rng.uniform(0.1, 1.4, n)) for n in (6, 5, 4))
    values = rng.uniform(0, 1, (6, 5, 4))
    turns = np.concatenate([p - np.pi, p, p + np.pi])
    scipy = RegularGridInterpolator(
        (np.sqrt(h), d, turns), np.concatenate([values] * 3, axis=2)
    )
    grid = DEFAULT_GRID
    at = np.meshgrid(
        np.sqrt(np.clip(grid.theta_h, h[0], h[-1])),
        np.clip(grid.theta_d, d[0], d[-1]),
        grid.phi_d,
        indexing="ij",
    )
    want = scipy(np.stack(at, axis=-1))
    found = to_grid(values, (h, d, p))
    np.testing.assert_allclose(found[1:], want[1:], atol=1e-6)  # single precision
    np.testing.assert_allclose(
        found[0], np.repeat(want[0].mean(axis=1, keepdims=True), 16, axis=1), atol=1e-6
    )


def test_read_tables__a_known_brdf_on_other_nodes(tmp_path):
    found = read_dictionary(_file(tmp_path / "a.npz"))
    want = (
        0.2
        * tabulate(
            lambda wi, wo: _known(*_shares(*half_difference(wi, wo)))[..., None],
            DEFAULT_GRID,
        )[..., 0]
    )
    assert found.names == ("known", "flat")
    assert found.source == "a.npz"
    np.testing.assert_allclose(found.table[..., 1], 0.2, rtol=1e-6)
    # 0.02 cos(2 phi_d) between 12 nodes: 0.0007; half vectors at the normal and theta_d
    # = 0 have no phi_d
    some = np.s_[1:, 1:-1]
    np.testing.assert_allclose(found.table[..., 0][some], want[some], atol=0.001)
    assert np.ptp(found.table[0, ..., 0], axis=-1).max() == 0
    assert found.origins[0].resampling_error < 0.01
    assert found.origins[1].resampling_error < 1e-6


def test_read_tables__rgb_is_averaged_and_holes_are_filled(tmp_path):
    with np.load(_file(tmp_path / "grey.npz")) as file:
        grey = file["basis_brdf"]
    colour = np.stack([grey, 2 * grey, 0 * grey], axis=-1)
    colour[1, 5, 7, 3, 2] = np.nan  # one channel of one node
    found = read_tables(_file(tmp_path / "rgb.npz", basis_brdf=colour, names=None))
    assert found.names == ("material0", "material1")
    np.testing.assert_allclose(
        found.table, read_tables(tmp_path / "grey.npz").table, rtol=1e-5
    )
    assert found.origins[0].hole_fraction == 0
    assert 0 < found.origins[1].hole_fraction < 1e-3


def test_write_tables__comes_back_bit_for_bit(tmp_path):
    shape = (DEFAULT_GRID.n_theta_h, DEFAULT_GRID.n_theta_d, DEFAULT_GRID.n_phi_d, 2)
    table = np.random.default_rng(0).uniform(0, 0.3, shape).astype(np.float32)
    write_tables(
        tmp_path / "a.npz", Dictionary(("x", "y"), table, DEFAULT_GRID, "test", 0.014)
    )
    found = read_tables(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.table, table)
    assert (found.names, found.disc_angular_radius) == (("x", "y"), 0.014)


def test_convolve_disc__never_twice(tmp_path):
    flat = np.full((*(len(v) for v in _nodes().values()),), 0.2)[None]
    own = read_tables(
        _file(
            tmp_path / "a.npz",
            basis_brdf=flat,
            names=None,
            disc_angular_radius=np.radians(0.8),
        )
    )
    assert convolve_disc(own, np.radians(0.805)) is own
    with pytest.raises(
        InputError,
        match=r"disc of these lights, 1.20 degrees; found a disc of 0.80 degrees",
    ):
        convolve_disc(own, np.radians(1.2))
    with pytest.raises(InputError, match=r"disc of these lights, 0\.00 degrees"):
        convolve_disc(own, 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"theta_h": None, "phi_d": None}, r"found no theta_h, phi_d; add them"),
        (
            {"basis_brdf": np.ones((40, 50, 12, 2))},
            r"shape \(materials, 40, 50, 12\).* found \(40, 50, 12, 2\)",
        ),
        (
            {"basis_brdf": np.ones((2, 40, 50, 12, 4))},
            r"with RGB .* found \(2, 40, 50, 12, 4\)",
        ),
        ({"basis_brdf": np.ones(5)}, r"found \(5,\)"),
        (
            {"basis_brdf": np.array(["a"])},
            "must be real numbers; found others in basis_brdf",
        ),
        (
            {"theta_d": _nodes()["theta_d"][::-1]},
            r"\[theta_d\]: nodes must be in strictly ascending order",
        ),
        (
            {"theta_d": np.ones((50, 1))},
            (
                r"\[theta_d\]: must be a one-dimensional array of at least 2 nodes; "
                r"found the shape \(50, 1\)"
            ),
        ),
        (
            {"theta_h": np.degrees(_nodes()["theta_h"])},
            "angles must be in rad; found 90; convert them with numpy.radians",
        ),
        (
            {"theta_h": 0.8 * _nodes()["theta_h"]},
            r"must extend from 0 to pi/2 rad.* found \[0, 1.25664\]",
        ),
        ({"phi_d": 2 * _nodes()["phi_d"]}, r"nodes must lie in \[0, pi\)"),
        (
            {"phi_d": 0.3 * _nodes()["phi_d"]},
            "at most pi/2 apart, also across the end of the period; found a gap of 2.28",
        ),
        (
            {"names": np.array(["a", "a"])},
            "as many different names; found 2 names, 1 of them different",
        ),
        (
            {"units": np.array("percent")},
            "the unit of a BRDF must be sr-1; found percent",
        ),
        (
            {"disc_angular_radius": np.array(0.8)},
            "one angle from 0 to 0.5 rad; found 0.8",
        ),
        (
            {"basis_brdf": np.full((2, 40, 50, 12), -0.1)},
            "must not be negative; found 48000 values below 0; use NaN where nothing",
        ),
        ({"basis_brdf": np.full((2, 40, 50, 12), np.inf)}, "found 48000 infinite"),
        ({"basis_brdf": np.full((2, 40, 50, 12), np.nan)}, "found 100% in material 0"),
        (
            {"basis_brdf": np.full((2, 40, 50, 12), 30.0)},
            r"found an albedo of 94.[23] at normal incidence; provide .* sr\^-1",
        ),
    ],
)
def test_read_tables__a_wrong_file_is_one_line(tmp_path, change, message):
    with pytest.raises(InputError, match=message) as caught:
        read_tables(_file(tmp_path / "a.npz", **change))
    assert len(caught.value.faults) == 1


def test_read_tables__every_fault_at_once(tmp_path):
    wrong = {
        "theta_d": _nodes()["theta_d"][::-1],
        "phi_d": 2 * _nodes()["phi_d"],
        "names": np.array(["a"]),
    }
    with pytest.raises(
        InputError, match="nodes must be in strictly ascending order"
    ) as caught:
        read_tables(_file(tmp_path / "a.npz", **wrong))
    assert len(caught.value.faults) == 3


@pytest.mark.parametrize("content", [None, b"", b"text", b"PK\x03\x04broken"])
def test_read_dictionary__what_is_no_table_is_one_line(tmp_path, content):
    if content is not None:
        (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError, match="npz"):
        read_dictionary(tmp_path / "a.npz")


def _cells() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 2, (*SHAPE, 3))


def test_read_merl__round_trip(tmp_path):
    table = _cells()
    write_merl(tmp_path / "a.binary", table)
    got, holes = read_merl(tmp_path / "a.binary")
    np.testing.assert_allclose(got, table, rtol=1e-14)
    assert holes == 0


def test_read_merl__layout_of_the_published_reader(tmp_path):
    """BRDFRead.cpp: ind = phi_d + theta_d * 180 + theta_h * 180 * 90; green one table
    on, scaled by 1.15 / 1500.
    """
    raw = np.zeros(3 * 90 * 90 * 180)
    raw[7 + 11 * 180 + 13 * 180 * 90 + 90 * 90 * 180] = 3000.0
    (tmp_path / "a.binary").write_bytes(
        np.array(SHAPE, "<i4").tobytes() + raw.tobytes()
    )
    table, _ = read_merl(tmp_path / "a.binary")
    assert table[13, 11, 7, 1] == pytest.approx(2.3)
    assert np.count_nonzero(table) == 1


def test_read_merl__holes_are_unknown_and_counted(tmp_path):
    write_merl(tmp_path / "a.binary", _cells())
    raw = bytearray((tmp_path / "a.binary").read_bytes())
    raw[12:20] = np.float64(-1.0).tobytes()
    (tmp_path / "a.binary").write_bytes(raw)
    got, holes = read_merl(tmp_path / "a.binary")
    assert holes == 1
    assert np.isnan(got[0, 0, 0]).all()  # also the channels that are not negative
    assert np.isfinite(got[0, 0, 1]).all()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda raw: raw[:1000], r"header \(90, 90, 180\) and 1000 bytes"),
        (lambda raw: raw[:5], "and 5 bytes"),
        (lambda raw: b"", "and 0 bytes"),
        (lambda raw: raw[:4] + raw[:4] + raw[4:], r"found the header \(90, 90, 90\)"),
        (
            lambda raw: raw[:12] + np.float64(np.nan).tobytes() + raw[20:],
            "values must be finite; found 1 that are not",
        ),
    ],
)
def test_read_merl__damage_is_one_line(tmp_path, damage, message):
    write_merl(tmp_path / "a.binary", _cells())
    (tmp_path / "a.binary").write_bytes(damage((tmp_path / "a.binary").read_bytes()))
    with pytest.raises(InputError, match=message):
        read_merl(tmp_path / "a.binary")


@pytest.mark.parametrize(
    ("shape", "value"),
    [((*SHAPE, 3), -1.0), ((*SHAPE, 3), np.nan), ((90, 90, 180), 1.0)],
)
def test_write_merl__refuses_what_is_not_a_table(tmp_path, shape, value):
    with pytest.raises(ValueError, match="a MERL table must have the shape"):
        write_merl(tmp_path / "a.binary", np.full(shape, value))


def test_read_merl__no_such_file(tmp_path):
    with pytest.raises(InputError, match="must be a readable file; found No such file"):
        read_merl(tmp_path / "a.binary")

"""MERL binary files compared with the layout of the reader that was published with them."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.errors import InputError
from skindb.reflectance.merl import SHAPE, read_merl, write_merl


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

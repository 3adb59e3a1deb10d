from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from skimage.io import imread

from skindb.errors import InputError
from skindb.render.image import (
    auto_exposure,
    encode_srgb,
    read_exr,
    tone_map,
    write_exr,
    write_png,
)
from tests.pictures import decode_srgb, read_png


@pytest.fixture
def radiance() -> np.ndarray:
    return np.random.default_rng(3).gamma(1.0, 20.0, (13, 17, 3)).astype(np.float32)


def test_encode_srgb__known_values_and_inverse() -> None:
    # 0.5 and 0.18 by hand from IEC 61966-2-1; 8-bit 188 and 118
    np.testing.assert_allclose(
        encode_srgb([0.5, 0.18, 0.001]) * 255, [187.516, 117.646, 3.2946], atol=2e-3
    )
    x = np.linspace(0, 1, 101)
    # the standard's own seam is 3e-8 wide
    np.testing.assert_allclose(decode_srgb(encode_srgb(x)), x, atol=3e-8)


def test_tone_map__exposure_takes_the_bright_quantile_to_white(
    radiance: np.ndarray,
) -> None:
    picture = tone_map(radiance)
    clipped = (picture.max(axis=-1) == 255).mean()
    assert 0 < clipped < 0.02
    np.testing.assert_array_equal(tone_map(radiance * 7), picture)


def test_tone_map__unknown_is_black_and_dark_stays_finite() -> None:
    values = np.array([[[np.nan, -1, 1e30]]])
    np.testing.assert_array_equal(tone_map(values, exposure=1.0), [[[0, 0, 255]]])
    assert auto_exposure(np.zeros((2, 2, 3))) == 1.0


def test_write_png__another_reader_sees_the_same(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (9, 8, 4), np.uint8)
    write_png(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(imread(tmp_path / "a.png"), picture)
    deep = np.random.default_rng(0).integers(0, 65536, (9, 8, 3), np.uint16)
    write_png(tmp_path / "b.png", deep)
    back = read_png(tmp_path / "b.png")
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back, deep)


def test_write_png__refuses_floats(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match="must be uint8 or uint16 for PNG, found float64"
    ):
        write_png(tmp_path / "a.png", np.zeros((2, 2)))


def test_write_exr__keeps_float32_and_names(
    tmp_path: Path, radiance: np.ndarray
) -> None:
    write_exr(tmp_path / "a.exr", radiance, attributes={"units": "sr-1"})
    back, names = read_exr(tmp_path / "a.exr")
    assert names == ("R", "G", "B")
    np.testing.assert_array_equal(back, radiance)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert file.header()["units"] == "sr-1"
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, radiance)


def test_write_exr__single_channel_and_half(tmp_path: Path) -> None:
    grey = np.linspace(0, 1, 12, dtype=np.float16).reshape(3, 4)
    write_exr(tmp_path / "y.exr", grey)
    back, names = read_exr(tmp_path / "y.exr")
    assert names == ("Y",)
    np.testing.assert_array_equal(back[..., 0], grey)


def test_read_exr__absent_and_truncated_are_the_users_mistakes(
    tmp_path: Path, radiance: np.ndarray
) -> None:
    with pytest.raises(
        InputError, match=r"nowhere\.exr: the file must exist; found no such file"
    ):
        read_exr(tmp_path / "nowhere.exr")
    write_exr(tmp_path / "a.exr", radiance)
    whole = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="complete OpenEXR image"):
        read_exr(tmp_path / "cut.exr")

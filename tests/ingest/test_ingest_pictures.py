"""Capture folders from pictures and tables of lights, and the surface that they show."""

from __future__ import annotations

import json
import os
import shutil
import unicodedata
from collections.abc import Sequence
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image
from planted_pictures import (
    ALBEDO,
    SIZE,
    directions,
    encoded,
    radiance,
    sphere_normals,
    write_pictures,
    write_table,
)

from skindb.errors import InputError
from skindb.format.frames import write_frame
from skindb.geometry.camera import project
from skindb.ingest import (
    IngestParameters,
    import_images,
    import_olat,
    ingest_capture,
    read_capture,
)
from skindb.ingest.light_tables import read_lights
from skindb.ingest.picture_files import exif_exposure, read_picture

PERSON = {"subject": "P1", "consent": {"scope": ["fit"], "reference": "form 1"}}
LIGHTS = directions(9)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """A folder of pictures with 16 bits and lights.csv."""
    folder = tmp_path / "pictures"
    write_table(folder / "lights.csv", write_pictures(folder, LIGHTS), LIGHTS)
    return folder


def ingested(capture: Path, scratch: Path, spacing: float = 0.1):
    """The version of a capture folder, loaded."""
    with ingest_capture(
        read_capture(capture), IngestParameters(spacing_mm=spacing), scratch=scratch
    ) as tree:
        return tree.load()


def true_normals(tree) -> np.ndarray:
    """Planted normals at the surfels."""
    dome = tree["dome"].to_dataset()
    position = tree["surfels"]["surfel_position"].values.astype(float)
    lens = [
        dome[f"camera_{name}"].values[0].astype(float)
        for name in ("matrix", "rotation", "translation", "distortion")
    ]
    column, row = np.floor(project(position, *lens)[0]).astype(int).T
    return sphere_normals()[row, column]


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


def test_a_surface_is_estimated_without_a_scan(pictures: Path, tmp_path: Path) -> None:
    result = import_images(pictures, tmp_path / "capture", PERSON, width_mm=48)
    assert (result.lights, result.cameras) == (9, 1)
    tree = ingested(tmp_path / "capture", tmp_path)
    assert float(tree["surfels"]["scan_normal_error"]) == 60
    assert int(tree["dome"]["relative_reflectance"]) == 1
    truth = true_normals(tree)
    inner = truth[:, 2] > 0.5
    assert inner.sum() > 700
    miss = angle(tree["surfels"]["surfel_normal"].values, truth)[inner]
    # one pixel is 3 degrees of the sphere
    assert np.median(miss) < 3
    # the depth of the sphere from its rim inwards: 1 mm is one pixel
    z = tree["surfels"]["surfel_position"].values[:, 2]
    depth = 20 * truth[:, 2]
    shift = np.median((z - depth)[inner])
    assert np.abs(z - depth - shift)[inner].max() < 1.5
    assert any("no prior" in line for line in tree.attrs["skipped"])
    assert any(
        "limited to the pixels" in note for note in tree.attrs["summary"]["notes"]
    )
    # a pixel, although the area of a surfel is larger on slopes
    assert tree.attrs["summary"]["surfels"]["spacing_mm"] == pytest.approx(1.0)
    assert any("relative" in line for line in tree.attrs["skipped"])


def test_samples_have_one_scale_for_all_captures_of_a_rig(
    pictures: Path, tmp_path: Path
) -> None:
    import_images(pictures, tmp_path / "capture", PERSON)
    tree = ingested(tmp_path / "capture", tmp_path)
    sample = tree["samples"]["reflectance_sample"].values[:, 0, 0]
    # white is R_d 0.5, facing: the planted radiance is 1.6 times the albedo
    facing = true_normals(tree)[:, 2] > 0.99
    expected = 1.6 * np.array(ALBEDO) * 0.5 / np.pi
    # the pixels around the pole face the light by 0.99 to 1
    assert np.allclose(np.nanmean(sample[facing], axis=0), expected, rtol=0.01)


@pytest.mark.parametrize(
    ("suffix", "dtype", "srgb"),
    [
        (".tif", "uint16", False),
        (".exr", "float32", False),
        (".png", "uint8", True),
    ],
)
def test_formats_give_the_same_normals(
    tmp_path: Path, suffix: str, dtype: str, srgb: bool
) -> None:
    folder = tmp_path / "pictures"
    names = write_pictures(folder, LIGHTS, suffix=suffix, dtype=dtype, srgb=srgb)
    write_table(folder / "x.lp", names, LIGHTS, separator=" ")
    result = import_images(folder, tmp_path / "capture", PERSON)
    assert any("sRGB" in note for note in result.notes) == srgb
    tree = ingested(tmp_path / "capture", tmp_path)
    truth = true_normals(tree)
    inner = truth[:, 2] > 0.5
    miss = angle(tree["surfels"]["surfel_normal"].values, truth)[inner]
    assert np.median(miss) < 3


def test_a_stated_response_gives_the_same_samples(tmp_path: Path) -> None:
    folder = tmp_path / "source"
    names = write_pictures(folder, LIGHTS, dtype="uint8", srgb=True)
    write_table(folder / "lights.csv", names, LIGHTS)
    import_images(folder, tmp_path / "srgb", PERSON)
    table = tmp_path / "srgb/dome/response.csv"
    import_images(folder, tmp_path / "stated", PERSON, response=str(table))
    record = json.loads((tmp_path / "stated/dome/dome.json").read_text())
    assert record["cameras"][0]["response"] == "dome/response.csv"
    stated = tmp_path / "stated/dome/response.csv"
    assert stated.read_text() == table.read_text()
    table.write_text("dn,r,g,b\n0,0,0,0\n")
    with pytest.raises(InputError, match="columns dn,r,g,b that all rise"):
        import_images(folder, tmp_path / "refused", PERSON, response=str(table))
    assert not (tmp_path / "refused").exists()


def test_near_lights_are_used_at_their_positions(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    # 1 mm a pixel; the origin is at the mean depth of the hemisphere of radius 20 mm
    position = 70.0 * LIGHTS + [[0, 0, 40 / 3]]
    normal = np.nan_to_num(sphere_normals())
    rows = []
    for k, light in enumerate(position):
        way = light - 20.0 * normal
        square = (way**2).sum(axis=-1)
        cosine = np.maximum((normal * way).sum(axis=-1), 0) / np.sqrt(square)
        linear = (cosine * 2000 / square)[..., None] * np.array(ALBEDO)
        write_frame(folder / f"{k}.png", encoded(linear, "uint16", srgb=False))
        rows.append(f"{k}.png,{light[0]},{light[1]},{light[2] - 40 / 3}")
    text = "\n".join(["picture,x_mm,y_mm,z_mm", *rows])
    (folder / "lights.csv").write_text(text)
    import_images(folder, tmp_path / "near", PERSON, width_mm=SIZE)
    tree = ingested(tmp_path / "near", tmp_path)
    near = true_normals(tree)
    inner = near[:, 2] > 0.5
    miss = angle(tree["surfels"]["surfel_normal"].values, near)[inner]
    text = text.replace("_mm", "")
    (folder / "lights.csv").write_text(text)
    import_images(folder, tmp_path / "far", PERSON, width_mm=SIZE)
    tree = ingested(tmp_path / "far", tmp_path)
    far = true_normals(tree)
    inner = far[:, 2] > 0.5
    wrong = angle(tree["surfels"]["surfel_normal"].values, far)[inner]
    # the pole is 7 mm in front of the plane of the first round, of lights at 70 mm
    assert np.median(miss) < 4 < 8 < np.median(wrong)


def test_a_mirror_ball_gives_the_directions(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    write_pictures(folder, LIGHTS)
    ball = tmp_path / "ball"
    ball.mkdir()
    row, column = np.mgrid[:200, :200] + 0.5
    away = np.stack([column - 100, 100 - row], axis=-1) / 80
    disc = (away**2).sum(axis=-1) < 1
    write_frame(
        ball / "mask.png", np.repeat(disc[..., None] * np.uint8(255), 3, axis=2)
    )
    for k, light in enumerate(LIGHTS):
        half = np.add(light, (0, 0, 1))
        half /= np.linalg.norm(half)
        spot = np.exp(-((away - half[:2]) ** 2).sum(axis=-1) / 2e-4) * disc
        picture = np.rint(255 * np.repeat(spot[..., None], 3, axis=2))
        write_frame(ball / f"{k}.png", picture.astype(np.uint8))
    import_images(folder, tmp_path / "capture", PERSON, mirror_ball=ball)
    dome = json.loads((tmp_path / "capture/dome/dome.json").read_text())
    found = np.array([light["direction"] for light in dome["lights"]])
    # a tenth of a pixel of the ball is 0.14 degrees
    assert angle(found, LIGHTS).max() < 0.2


def test_jpeg_is_turned_as_it_is_looked_at(tmp_path: Path) -> None:
    values = np.zeros((20, 30, 3), np.uint8)
    values[:, :10] = 200
    image = Image.fromarray(values)
    exif = image.getexif()
    exif[0x0112] = 6  # to be turned by 90 degrees to the right
    image.save(tmp_path / "x.jpg", exif=exif, quality=95)
    picture = read_picture(tmp_path / "x.jpg")
    assert picture.shape == (30, 20, 3)
    assert picture[:8].min() > 180 > 20 > picture[12:].max()


def write_photographs(
    folder: Path, seconds: Sequence[float], lights: np.ndarray = LIGHTS
) -> list[str]:
    """JPEG pictures whose EXIF states exposures."""
    stems = write_pictures(folder, lights, dtype="uint8", srgb=True)
    for stem, time in zip(stems, seconds, strict=True):
        path = folder / stem
        exif = Image.Exif()
        tags = exif.get_ifd(ExifTags.IFD.Exif)
        tags[ExifTags.Base.ExposureTime] = time
        tags[ExifTags.Base.ISOSpeedRatings] = 200
        tags[ExifTags.Base.FNumber] = 2.0
        tags[ExifTags.Base.WhiteBalance] = 0
        Image.open(path).save(path.with_suffix(".jpg"), quality=98, exif=exif)
        path.unlink()
    return [f"{Path(stem).stem}.jpg" for stem in stems]


def test_exposures_of_pictures_are_compared_and_recorded(tmp_path: Path) -> None:
    times = np.full(len(LIGHTS), 0.01)
    names = write_photographs(tmp_path / "even", times)
    write_table(tmp_path / "even/lights.csv", names, LIGHTS)
    result = import_images(tmp_path / "even", tmp_path / "capture", PERSON)
    dome = json.loads((tmp_path / "capture/dome/dome.json").read_text())
    assert dome["relative_exposure"] == pytest.approx(0.01 * 2 / 4)
    assert "white balance" in " ".join(result.notes)
    times[3] = 0.04
    names = write_photographs(tmp_path / "uneven", times)
    table = tmp_path / "uneven/lights.csv"
    write_table(table, names, LIGHTS)
    with pytest.raises(InputError, match=r"times 4 for picture 3\.jpg"):
        import_images(table.parent, tmp_path / "again", PERSON)
    rows = table.read_text().splitlines()
    rows = [f"{row},{time}" for row, time in zip(rows[1:], times, strict=True)]
    table.write_text("\n".join(["picture,x,y,z,intensity", *rows]))
    import_images(table.parent, tmp_path / "again", PERSON)
    dome = json.loads((tmp_path / "again/dome/dome.json").read_text())
    lit, exposure = dome["lights"][3]["intensity"][0], dome["relative_exposure"]
    # most pictures are short here and long there: what white is in counts per intensity
    table.write_text(
        "\n".join(
            ["picture,x,y,z,intensity"]
            + [f"{row.rsplit(',', 1)[0]},0.04" for row in rows[:-1]]
            + [rows[-1]]
        )
    )
    import_images(table.parent, tmp_path / "long", PERSON)
    dome = json.loads((tmp_path / "long/dome/dome.json").read_text())
    scale = dome["lights"][3]["intensity"][0] / lit
    assert dome["relative_exposure"] * scale == pytest.approx(exposure)


def test_damaged_exif_states_nothing(tmp_path: Path) -> None:
    (name,) = write_photographs(tmp_path, [0.01], LIGHTS[:1])
    path = tmp_path / name
    whole = path.read_bytes()
    assert exif_exposure(path) == (pytest.approx(0.005), True)
    begin = whole.index(b"Exif")
    for place in range(begin + 6, begin + 60):
        path.write_bytes(whole[:place] + b"\xff" + whole[place + 1 :])
        exposure, _ = exif_exposure(path)  # which neither fails nor warns
        assert 0 <= exposure < np.inf


def test_a_mask_and_grey_pictures(pictures: Path, tmp_path: Path) -> None:
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[:, : SIZE // 2] = 255
    Image.fromarray(mask).save(pictures / "mask.png")
    import_images(pictures, tmp_path / "capture", PERSON)
    tree = ingested(tmp_path / "capture", tmp_path)
    assert tree["surfels"]["surfel_position"].values[:, 0].max() < 0
    assert np.array_equal(
        read_picture(pictures / "mask.png"), np.repeat(mask[..., None], 3, axis=2)
    )


@pytest.mark.parametrize(
    ("text", "lights"),
    [
        ("a.png 1 0 1\nb.png 0 1 1\n", 2),
        ("2\nmy file.png 1 0 1\nC:\\x\\b.png 0 1 1\n", 2),
        ("a.png;1,0;0,0;1,0\nb.png;0;1;1\n", 2),
        ("a#1.png 1 0 1 # left\nb.png 0 1 1\n", 2),
        ("kä #se.png,1,0,1\nb.png,0,1,1\n", 2),
        ("shot 2 #3.png,1,0,1\nb.png,0,1,1 # left\n", 2),
        ('"seven, comma.png",1,0,1\n"b.png", 0, 1, 1\n', 2),
        ("name,x,y,z,exposure\na.png,1,0,1,1/60\nb.png,0,1,1,1/30\n", 2),
        ("# comment\nname;x;y;z;intensity\na.png;1;0;1;2\nb.png;0;1;1;1\n", 2),
    ],
)
def test_tables_of_lights(tmp_path: Path, text: str, lights: int) -> None:
    path = tmp_path / "lights.csv"
    path.write_text(text)
    table = read_lights(path)
    assert len(table) == lights
    assert np.array_equal(table[0].vector, [1, 0, 1])
    assert table[1].name == "b.png"


def test_directions_without_names_are_those_of_the_pictures_in_their_order(
    tmp_path: Path,
) -> None:
    path = tmp_path / "light_directions.txt"
    path.write_text("X,Y,Z\n1,0,1\n\n0.5 -0.5 1\n")
    table = read_lights(path, ["p2.png", "p10.png"])
    assert [light.name for light in table] == ["p2.png", "p10.png"]
    assert np.array_equal(table[1].vector, [0.5, -0.5, 1])
    with pytest.raises(InputError, match="2 lines for 3 pictures"):
        read_lights(path, ["p2.png", "p10.png", "q.png"])
    # a name is missing in one line only
    path.write_text("a.png 1 0 1\n0.5 -0.5 1\n")
    with pytest.raises(InputError, match="line 2"):
        read_lights(path, ["a.png", "b.png"])


def test_a_grey_picture_beside_others_in_colour_is_noted(tmp_path: Path) -> None:
    lights = directions(4)
    names = write_pictures(tmp_path / "pictures", lights)
    write_table(tmp_path / "pictures/lights.csv", names, lights)
    first = tmp_path / "pictures" / names[0]
    write_frame(first, np.repeat(read_picture(first)[..., :1], 3, axis=2))
    notes = import_images(tmp_path / "pictures", tmp_path / "capture", PERSON).notes
    assert any(note.startswith(f"{names[0]} is grey") for note in notes)


def test_copies_are_named_by_their_pictures(tmp_path: Path) -> None:
    lights = directions(4)
    names = write_pictures(tmp_path / "pictures", lights)
    write_table(tmp_path / "pictures/lights.csv", names, lights)
    shutil.copy(tmp_path / "pictures" / names[1], tmp_path / "pictures" / names[3])
    with pytest.raises(InputError, match=f"{names[3]}: .*a copy of {names[1]}"):
        import_images(tmp_path / "pictures", tmp_path / "capture", PERSON)


def test_two_pictures_under_one_light_are_noted(tmp_path: Path) -> None:
    lights = directions(5)
    lights[4] = 2 * lights[1]
    names = write_pictures(tmp_path / "pictures", lights)
    write_table(tmp_path / "pictures/lights.csv", names, lights)
    notes = import_images(tmp_path / "pictures", tmp_path / "capture", PERSON).notes
    assert f"pictures under a light in the same place: {names[1]}, {names[4]}" in notes


def test_what_is_assumed_of_pictures_is_noted(tmp_path: Path) -> None:
    lights = directions(4)
    write_pictures(tmp_path / "pictures", lights, suffix=".tif")
    table = tmp_path / "directions.txt"
    np.savetxt(table, lights)
    notes = import_images(
        tmp_path / "pictures", tmp_path / "capture", PERSON, lights=table
    ).notes
    assert any("16 bits are taken as linear; --response srgb" in note for note in notes)
    assert any("in their order" in note for note in notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a.png,1,0,1\na.png,0,1,1\n", "twice"),
        ("a.png,0,0,0\n", "line 1"),
        ("a.png,1e999,0,1\n", "line 1"),
        ("a.png,1,nan,0\n", "line 1"),
        ("picture,x,y,z\na.png,1,zero,1\n", "line 2"),
        ("a.png,x,y,z,intensity\nb.png,1,0,1,-1\n", "line 2"),
        ("picture,x,y,z,intensities\na.png,1,0,1,5\n", "write intensity"),
        ("picture,x,y,z,gain\na.png,1,0,1,5\n", "write intensity"),
        ("picture,azimuth,elevation\na.png,10,20\n", "a header names .*azimuth"),
        ("", "0 lights"),
        ("a.png,-0,7,0,1,0,7\n", "decimal points"),
        ("picture,x,y,z\na.png,1,0,1,2\n", "4 cells"),
    ],
)
def test_faulty_tables_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "lights.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_lights(path)


def test_formats_that_would_be_read_wrongly(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.uint16).reshape(4, 6)
    grey = tmp_path / "grey.jpg"  # a PNG
    grey.write_bytes(imagecodecs.png_encode(values * 1000))
    assert np.array_equal(read_picture(grey)[..., 0], values * 1000)
    colour = np.repeat(values[..., None], 3, axis=2)
    plain = tmp_path / "plain.tif"
    tifffile.imwrite(plain, colour, photometric="rgb")
    assert np.array_equal(read_picture(plain), colour)
    options = {
        "planes": {"photometric": "rgb", "planarconfig": "separate"},
        "inverted": {"photometric": "miniswhite"},
        "turned": {"photometric": "rgb", "extratags": [(274, "H", 1, 6, True)]},
        "float": {"photometric": "rgb"},
        "bits": {"photometric": "rgb", "bitspersample": 12},
        "infrared": {"photometric": "rgb", "extrasamples": ["unspecified"]},
    }
    for name, option in options.items():
        picture = {
            "planes": np.moveaxis(colour, 2, 0),
            "inverted": values,
            "float": colour.astype(np.float32),
            "infrared": colour[..., [0, 1, 2, 0]],
        }.get(name, colour)
        path = tmp_path / f"{name}.tif"
        tifffile.imwrite(path, picture, **option)
        with pytest.raises(InputError, match="plain TIFF"):
            read_picture(path)


def test_what_is_transparent_is_black(tmp_path: Path) -> None:
    cut = np.full((4, 6, 4), 255, np.uint8)
    cut[:, :3, 3] = 0
    options = {"extrasamples": ["unassalpha"], "photometric": "rgb"}
    tifffile.imwrite(tmp_path / "cut.tif", cut, **options)
    Image.fromarray(cut).save(tmp_path / "cut.png")
    for path in tmp_path.iterdir():
        picture = read_picture(path)
        assert picture.shape == (4, 6, 3)
        assert (picture[:, :3] == 0).all()
        assert (picture[:, 3:] == 255).all()


def test_turned_png_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "turned.png"
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.new("RGB", (4, 6)).save(path, exif=exif)
    with pytest.raises(InputError, match="a turned picture"):
        read_picture(path)


def test_masks_and_repeated_pictures_are_not_guessed(
    pictures: Path, tmp_path: Path
) -> None:
    white = np.full((SIZE, SIZE, 3), 255, np.uint8)
    write_frame(pictures / "mask.png", 0 * white)
    with pytest.raises(InputError, match="no bright pixel"):
        import_images(pictures, tmp_path / "capture", PERSON)
    write_frame(pictures / "other mask.png", white)
    with pytest.raises(InputError, match="at most one picture"):
        import_images(pictures, tmp_path / "capture", PERSON)
    table = pictures / "lights.csv"
    table.write_text(table.read_text() + "picture 1,0,0,1\n")
    with pytest.raises(InputError, match="twice"):
        import_images(
            pictures, tmp_path / "capture", PERSON, mask=pictures / "other mask.png"
        )


def test_composed_and_decomposed_names_are_the_same(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    names = write_pictures(folder, LIGHTS)
    for name in names:
        (folder / name).rename(folder / unicodedata.normalize("NFD", f"ü{name}"))
    table = [unicodedata.normalize("NFC", f"Ü{name}") for name in names]
    write_table(folder / "lights.csv", table, LIGHTS)
    assert import_images(folder, tmp_path / "capture", PERSON).lights == 9


@pytest.mark.parametrize(
    ("scale", "white"), [(0.3, 1), (0.9, 1), (0.02, 4**-2), (30, 64)]
)
def test_linear_pictures_keep_their_scale(
    tmp_path: Path, scale: float, white: float
) -> None:
    """Two subjects of one rig are not made equally bright."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    names = [f"{k}.exr" for k in range(len(LIGHTS))]
    for name, light in zip(names, LIGHTS, strict=True):
        write_frame(folder / name, (2 * scale * radiance(light)).astype(np.float32))
    write_table(folder / "lights.csv", names, LIGHTS)
    result = import_images(folder, tmp_path / "capture", PERSON)
    dome = json.loads((tmp_path / "capture/dome/dome.json").read_text())
    assert dome["lights"][0]["intensity"][0] == pytest.approx(2 * np.pi * white)
    assert any("taken as white" in note for note in result.notes) == (white != 1)


def test_relative_intensities_have_any_unit(pictures: Path, tmp_path: Path) -> None:
    table = pictures / "lights.csv"
    lines = table.read_text().splitlines()
    rows = [f"{line},{1000 + k}" for k, line in enumerate(lines[1:])]
    table.write_text("\n".join([f"{lines[0]},intensity", *rows]))
    import_images(pictures, tmp_path / "capture", PERSON)
    dome = json.loads((tmp_path / "capture/dome/dome.json").read_text())
    values = [light["intensity"][0] for light in dome["lights"]]
    assert values[4] == pytest.approx(2 * np.pi)
    assert values[8] / values[0] == pytest.approx(1008 / 1000)


def test_black_pictures_are_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    names = [f"{k}.png" for k in range(len(LIGHTS))]
    for name in names:
        write_frame(folder / name, np.zeros((SIZE, SIZE, 3), np.uint8))
    write_table(folder / "lights.csv", names, LIGHTS)
    import_images(folder, tmp_path / "capture", PERSON)
    with pytest.raises(InputError):
        ingested(tmp_path / "capture", tmp_path)


def test_an_import_that_stops_leaves_nothing(pictures: Path, tmp_path: Path) -> None:
    def stop(_: str, done: int, __: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    out = tmp_path / "capture"
    out.mkdir()
    with pytest.raises(KeyboardInterrupt):
        import_images(pictures, out, PERSON, progress=stop)
    assert not any(out.iterdir())


def test_every_faulty_picture_is_named_and_nothing_is_left(
    pictures: Path, tmp_path: Path
) -> None:
    (pictures / "picture 3.png").write_bytes(b"no picture")
    write_frame(pictures / "picture 5.png", np.zeros((4, 5, 3), np.uint16))
    with pytest.raises(InputError) as error:
        import_images(pictures, tmp_path / "capture", PERSON)
    text = str(error.value)
    assert "picture 3.png" in text
    assert "picture 5.png" in text
    assert not (tmp_path / "capture").exists()


def test_lights_without_pictures_and_two_lights_are_refused(
    pictures: Path, tmp_path: Path
) -> None:
    table = pictures / "lights.csv"
    text = table.read_text()
    table.write_text(f"{text}gone.png,0,0,1\n")
    with pytest.raises(InputError, match=r"gone\.png"):
        import_images(pictures, tmp_path / "capture", PERSON)
    table.write_text("\n".join(text.splitlines()[:3]))
    with pytest.raises(InputError, match="3 lights or more; found picture 0"):
        import_images(pictures, tmp_path / "capture", PERSON)


def test_a_background_of_one_dim_value_is_no_surface(tmp_path: Path) -> None:
    """Such as a black level that nobody stated."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    names = [f"{k}.png" for k in range(len(LIGHTS))]
    for name, light in zip(names, LIGHTS, strict=True):
        picture = np.maximum(radiance(light), 0.06)
        write_frame(folder / name, encoded(picture, "uint16", srgb=False))
    write_table(folder / "lights.csv", names, LIGHTS)
    import_images(folder, tmp_path / "capture", PERSON, width_mm=SIZE)
    tree = ingested(tmp_path / "capture", tmp_path)
    place = tree["surfels"]["surfel_position"].values[:, :2]
    # the radius of the sphere is 20 mm
    assert np.linalg.norm(place, axis=1).max() < 21


def test_a_light_stage(tmp_path: Path) -> None:
    """One camera by COLMAP's text model, pictures as LIGHT_CAMERA."""
    source = tmp_path / "stage"
    source.mkdir()
    names = [f"L{k}" for k in range(len(LIGHTS))]
    for name, light in zip(names, LIGHTS, strict=True):
        write_frame(
            source / f"{name}_front.png", encoded(radiance(light), "uint16", srgb=False)
        )
    write_table(source / "lights.csv", names, LIGHTS)
    focal = 10_000
    (source / "cameras.txt").write_text(
        f"# id\n1 PINHOLE 48 48 {focal} {focal} 24 24\n"
    )
    # turned by 180 degrees about x: y up, z to the camera
    (source / "images.txt").write_text("# id\n1 0 1 0 0 0 0 10000 1 front.png\n1 2 3\n")
    result = import_olat(source, tmp_path / "capture", PERSON)
    assert result.notes[0] == "pictures are {light}_{camera}.png"
    tree = ingested(tmp_path / "capture", tmp_path)
    truth = true_normals(tree)
    inner = truth[:, 2] > 0.5
    miss = angle(tree["surfels"]["surfel_normal"].values, truth)[inner]
    assert np.median(miss) < 3
    images = source / "images.txt"
    text = images.read_text()
    for wrong, words in (
        (text + text.splitlines()[1] + "\n\n", "two images of camera"),
        (text.replace("\n1 2 3\n", "\n2 0 1 0 0 0 0 10000 1 back.png\n"), "its points"),
        (text.replace("1 0 1 0", "1 0 one 0"), "text model"),
    ):
        images.write_text(wrong)
        with pytest.raises(InputError, match=words):
            import_olat(source, tmp_path / "again", PERSON)
    images.write_text(text)
    record = {"id": 1, "K": "hello", "R": [], "t": [0, 0, 1], "width": "48"}
    (source / "cameras.json").write_text(json.dumps([record]))
    with pytest.raises(InputError) as error:
        import_olat(source, tmp_path / "again", PERSON)
    assert len(error.value.faults) == 4
    (source / "cameras.json").unlink()
    write_frame(source / "L3_front.PNG", np.zeros((3, 4, 3), np.uint16))
    (source / "L3_front.png").unlink()
    with pytest.raises(InputError, match="48 x 48"):
        import_olat(source, tmp_path / "again", PERSON)
    (source / "L4_front.png").unlink()
    with pytest.raises(InputError, match="none of light L4, camera front"):
        import_olat(source, tmp_path / "again", PERSON)


def test_several_cameras_need_a_scan(pictures: Path, tmp_path: Path) -> None:
    import_images(pictures, tmp_path / "capture", PERSON)
    path = tmp_path / "capture/dome/dome.json"
    dome = json.loads(path.read_text())
    dome["cameras"].append(dome["cameras"][0] | {"id": "c01"})
    for frame in (tmp_path / "capture/dome/frames").glob("*_c00.png"):
        frame.with_name(frame.name.replace("c00", "c01")).write_bytes(
            frame.read_bytes()
        )
    path.write_text(json.dumps(dome))
    with pytest.raises(InputError, match="photogrammetry"):
        read_capture(tmp_path / "capture")


@pytest.mark.parametrize(
    ("axes", "signs", "note"),
    [
        ([0, 1, 2], [1, 1, 1], ""),
        ([0, 1, 2], [-1, 1, 1], "mirrored"),
        ([0, 1, 2], [1, -1, 1], "mirrored"),
        ([1, 0, 2], [1, 1, 1], "exchanged in x and y"),
        ([1, 0, 2], [-1, -1, 1], "exchanged in x and y"),
        ([1, 0, 2], [1, -1, 1], "turned by 90 degrees"),
        ([0, 1, 2], [-1, -1, 1], "turned by 180 degrees"),
    ],
)
def test_wrong_axes_of_lights_are_noted(
    tmp_path: Path, axes: list[int], signs: list[int], note: str
) -> None:
    names = write_pictures(tmp_path / "pictures", LIGHTS)
    stated = LIGHTS[:, axes] * signs
    write_table(tmp_path / "pictures/lights.csv", names, stated)
    import_images(tmp_path / "pictures", tmp_path / "capture", PERSON)
    tree = ingested(tmp_path / "capture", tmp_path)
    notes = " ".join(tree.attrs["summary"]["notes"])
    assert ("lights seem to be" in notes) == bool(note)
    assert note in notes


def test_flat_surfaces_have_no_wrong_axes(tmp_path: Path) -> None:
    names = write_pictures(tmp_path / "pictures", LIGHTS)
    rng = np.random.default_rng(2)
    for name, light in zip(names, LIGHTS, strict=True):
        picture = 0.5 * light[2] + rng.normal(0, 0.005, (SIZE, SIZE, 3))
        write_frame(
            tmp_path / "pictures" / name, encoded(picture, "uint16", srgb=False)
        )
    write_table(tmp_path / "pictures/lights.csv", names, LIGHTS)
    import_images(tmp_path / "pictures", tmp_path / "capture", PERSON)
    tree = ingested(tmp_path / "capture", tmp_path)
    notes = " ".join(tree.attrs["summary"]["notes"])
    assert "lights seem to be" not in notes


def noisy_capture(
    tmp_path: Path, *, level: float, albedo: tuple[float, ...] = ALBEDO
) -> Path:
    """A capture with noise of 0.006, a background of this level and a bright corner."""
    rng = np.random.default_rng(3)
    folder = tmp_path / "pictures"
    names = write_pictures(folder, LIGHTS)
    for name, light in zip(names, LIGHTS, strict=True):
        picture = radiance(light, albedo)
        picture[~np.isfinite(sphere_normals()[..., 2])] += level
        picture[:6, :6] += 0.6 * light[2]
        picture += rng.normal(0, 0.006, picture.shape)
        write_frame(folder / name, encoded(picture.clip(0, 1), "uint16", srgb=False))
    write_table(folder / "lights.csv", names, LIGHTS)
    import_images(folder, tmp_path / "capture", PERSON)
    return tmp_path / "capture"


def test_the_noise_of_a_dark_background_is_no_surface(tmp_path: Path) -> None:
    tree = ingested(noisy_capture(tmp_path, level=0.03), tmp_path)
    truth = true_normals(tree)[:, 2]
    sphere = np.isfinite(sphere_normals()[..., 2]).sum()
    assert np.isfinite(truth).sum() > 0.95 * sphere
    # two pixels around the sphere, whose neighbours are lit
    assert np.isnan(truth).sum() < 4 * np.sqrt(np.pi * sphere)
    assert any("dark background" in note for note in tree.attrs["summary"]["notes"])


def test_a_dark_subject_is_no_background(tmp_path: Path) -> None:
    dark = (0.06, 0.04, 0.02)  # 6 % of the bright corner
    tree = ingested(noisy_capture(tmp_path, level=0.0, albedo=dark), tmp_path)
    sphere = np.isfinite(sphere_normals()[..., 2]).sum()
    assert np.isfinite(true_normals(tree)[:, 2]).sum() > 0.95 * sphere


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ([1, 1, -1], r"lights.csv: 3 lights or more .* found 9 of 9 behind it"),
        ([1, 0, 1], "must not be in a plane"),
        ([0, 0, 1], "must not be in a plane"),
    ],
)
def test_lights_that_show_no_normals_are_faults_of_the_table(
    pictures: Path, tmp_path: Path, change: list[int], message: str
) -> None:
    names = [f"picture {k}.png" for k in range(9)]
    write_table(pictures / "lights.csv", names, LIGHTS * change)
    with pytest.raises(InputError, match=message):
        import_images(pictures, tmp_path / "capture", PERSON)


def test_notes_name_what_is_odd(pictures: Path, tmp_path: Path) -> None:
    names = [f"picture {k}.png" for k in range(8)]
    lights = LIGHTS[:8].copy()
    lights[7, 2] *= -1
    write_table(pictures / "lights.csv", names, lights)
    notes = import_images(pictures, tmp_path / "capture", PERSON).notes
    assert "pictures without a light are not used: picture 8.png" in notes
    assert "lights behind the subject, z not above 0: picture 7.png" in notes


def test_a_session_from_the_times_of_files_is_noted(
    pictures: Path, tmp_path: Path
) -> None:
    for k, file in enumerate(sorted(pictures.glob("*.png"))):
        os.utime(file, (1e9 + k, 1e9 + k))
    notes = import_images(pictures, tmp_path / "capture", PERSON).notes
    start = "session 2001-09-09T01:46:48+00:00 is the time of the newest picture file"
    assert any(note.startswith(start) for note in notes)
    stated = PERSON | {"session": "2005-01-10T09:00:00+01:00"}
    notes = import_images(pictures, tmp_path / "stated", stated).notes
    assert not any(note.startswith("session") for note in notes)


def test_the_first_picture_is_named_if_it_differs(
    pictures: Path, tmp_path: Path
) -> None:
    odd = pictures / "picture 0.png"
    write_frame(odd, np.zeros((SIZE, SIZE - 4, 3), np.uint16))
    with pytest.raises(InputError) as error:
        import_images(pictures, tmp_path / "capture", PERSON)
    (fault,) = error.value.faults
    assert fault.where == str(odd)

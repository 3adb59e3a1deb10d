"""Capture folders from what people have: a folder of pictures with directions of the
lights, or light-stage folders with one picture for each light and camera.
"""

import json
import re
import shutil
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from skindb.calibration.mirror_ball import ball_outline, distant_light, highlight_centre
from skindb.errors import Fault, attempt, few_names, require, require_none
from skindb.files import Attributes, Json, make_private, private_file, read_regular
from skindb.format.dome import EXPOSURE_RATIO
from skindb.format.fields import IDENTIFIER, Fields, short
from skindb.format.folder import FORMAT, record_faults
from skindb.format.frames import write_frame
from skindb.format.sensor import read_response
from skindb.ingest.light_tables import Light, read_lights
from skindb.ingest.picture_files import (
    FORMATS,
    SUFFIXES,
    exif_exposure,
    read_picture,
)
from skindb.ingest.relief import MIN_LIGHTS, MIN_SPREAD
from skindb.ingest.stage_cameras import read_cameras
from skindb.limits import MAX_SCAN_BYTES
from skindb.parameters import ImportParameters
from skindb.types import Mask, Progress, silent

CAMERA = "c00"
# mm; distance of a camera whose lens is not known: perspective is below a hundredth
CAMERA_DISTANCE_MM = 10_000.0
# mm; of the longer side, and of a pixel at most: wider ones get no samples where the surface
# is oblique, see MAX_SMEAR_MM of skindb/ingest/lumitexels.py
WIDTH_MM = 250.0
MAX_PIXEL_MM = 6.0
# R_d of a facing surface that is as bright as the white level
WHITE_REFLECTANCE = 0.5
# of the radiances of linear files, which takes the place of the white level
BRIGHT_QUANTILE = 0.999
MASK = re.compile(r"(?<![a-z])mask(?![a-z])")
PATTERNS = (
    "{camera}/{light}",
    "{light}/{camera}",
    "{camera}_{light}",
    "{light}_{camera}",
)


@dataclass(frozen=True)
class Imported:
    """What an import wrote and assumed."""

    folder: Path
    lights: int
    cameras: int
    notes: tuple[str, ...]


def import_images(
    source: str | Path,
    out: str | Path,
    person: Attributes,
    *,
    progress: Progress = silent,
    **parameters: Any,
) -> Imported:
    """Write a capture folder from pictures of one camera, each under one light.

    Parameters
    ----------
    source
        Folder of the pictures: PNG, TIFF, JPEG, BMP or OpenEXR, all of one size.
    out
        Capture folder to write, which must not exist.
    person
        `subject`, `consent` and optional keys of capture.json, such as `condition`.
    progress
        Callback.
    **parameters
        Of `skindb.parameters.PictureParameters`: lights, by default lights.csv or the
        only .lp file in the folder; mirror_ball; mask, by default the picture `*mask*`
        in the folder, if there is one; response; width_mm, by default 250 for the
        longer side, or less for pixels of at most 6 mm.

    Returns
    -------
    Imported
        The folder, and what was assumed.

    Raises
    ------
    InputError
        With every picture that is absent, unreadable or of another size, or a table or
        record with faults.
    """
    source, out = Path(source), Path(out)
    chosen = _parameters(parameters, "pictures of one camera", "cameras", "scan")
    _require_writable(out, person)
    files, masks = _pictures(source)
    require(
        chosen.mask is not None or len(masks) < 2,
        str(source),
        "a folder must have at most one picture *mask*",
        ", ".join(file.name for file in masks[:3]),
        "name one with --mask",
    )
    notes = []
    if chosen.mirror_ball is not None:
        place = chosen.mirror_ball
        table = _from_ball(place, files)
        notes.append(f"{len(table)} directions of lights from the mirror ball")
    else:
        place = _table_file(source, chosen.lights)
        table = read_lights(place, [file.name for file in files])
        if table[0].by_order:
            notes.append(
                f"the directions are those of the pictures in their order, {files[0].name} first"
            )
    matched = _matched(source, files, table)
    notes += _require_directions(place, table)
    frames = _Frames(out, _typical(matched), chosen.response)
    height, width = frames.size
    inside = _mask(chosen.mask or _only(masks), frames.size)
    width_mm = chosen.width_mm
    if width_mm is None:
        width_mm = width * min(WIDTH_MM / max(width, height), MAX_PIXEL_MM)
        notes.append(
            f"the picture is taken as {width_mm:.0f} mm wide on the subject; --width states it"
        )
    if unused := [file.name for file in files if file not in matched]:
        notes.append(f"pictures without a light are not used: {few_names(unused)}")
    ids = _ids([light.name for light in table])
    camera = _distant_camera(width, height, width_mm)
    with _whole(out):
        for k, (file, name) in enumerate(zip(matched, ids, strict=True)):
            frames.add(file, name, camera, inside)
            progress("import", k + 1, len(matched))
        frames.finish(person, [camera], table, ids)
    return Imported(out, len(matched), 1, (*notes, *frames.notes))


def import_olat(
    source: str | Path,
    out: str | Path,
    person: Attributes,
    *,
    progress: Progress = silent,
    **parameters: Any,
) -> Imported:
    """Write a capture folder from a light stage: one picture for each light and camera.

    Parameters
    ----------
    source
        Folder with the pictures as CAMERA/LIGHT, LIGHT/CAMERA, CAMERA_LIGHT or
        LIGHT_CAMERA with any suffix of a picture.
    out, person, progress
        As in `import_images`.
    **parameters
        Of `skindb.parameters.ImportParameters`: lights, as in `import_images`; response;
        cameras, by default cameras.json or the folder itself; scan, by default the only
        one in the folder.

    Returns
    -------
    Imported
        The folder, and what was assumed.

    Raises
    ------
    InputError
        With every picture that is absent, unreadable or of another size than its camera.
    """
    source, out = Path(source), Path(out)
    chosen = _parameters(parameters, "a light stage", "mirror_ball", "mask", "width_mm")
    _require_writable(out, person)
    table = read_lights(_table_file(source, chosen.lights))
    devices = read_cameras(source, chosen.cameras)
    names = [light.name for light in table]
    cameras = [str(device["id"]) for device in devices]
    pattern, files = _olat_files(source, names, cameras)
    frames = _Frames(out, next(iter(files.values())), chosen.response)
    ids = _ids(names)
    light_ids = dict(zip(names, ids, strict=True))
    by_name = dict(zip(cameras, devices, strict=True))
    for device, name in zip(devices, _ids(cameras), strict=True):
        device["id"] = name
    meshes = sorted([*source.glob("*.ply"), *source.glob("*.obj")])
    scan = chosen.scan or _only(meshes)
    with _whole(out):
        for k, ((light, camera), file) in enumerate(files.items()):
            frames.add(file, light_ids[light], by_name[camera])
            progress("import", k + 1, len(files))
        frames.finish(person, devices, table, ids, scan)
    notes = (f"pictures are {pattern}{frames.first.suffix}", *frames.notes)
    return Imported(out, len(table), len(devices), notes)


def _parameters(values: Attributes, source: str, *foreign: str) -> ImportParameters:
    """The parameters of an import, none of which belongs to other sources."""
    paths = ("lights", "mirror_ball", "mask", "cameras", "scan")
    stated = {n: Path(values[n]) for n in paths if values.get(n) is not None}
    chosen = ImportParameters(**{**values, **stated})
    faults = [
        Fault(name, f"does not apply to {source}", str(value), "remove it")
        for name in foreign
        if (value := getattr(chosen, name)) is not None
    ]
    require_none(faults)
    return chosen


@contextmanager
def _whole(out: Path) -> Iterator[None]:
    """Context in which a folder is written, or nothing remains of it."""
    existed = out.exists()
    try:
        yield
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        if existed:
            make_private(out)
        raise


def _white_level(bright: float) -> float:
    """Power of four that is the white level of linear files whose bright pixels have this
    radiance: 1 for 0.4 to 1.5. Steps keep takes of one rig comparable.
    """
    if not bright > 0:
        return 1.0
    return float(4.0 ** np.ceil(np.log(bright / 1.5) / np.log(4)))


class _Frames:
    """The frames of a capture folder that is written from pictures."""

    def __init__(self, out: Path, first: Path, response: str) -> None:
        picture = read_picture(first)
        self.out = out
        self.first = first
        self.size = picture.shape[:2]
        self.dtype = picture.dtype
        self.linear = picture.dtype.kind == "f"
        self.suffix = ".exr" if self.linear else ".png"
        automatic = response == "auto" and picture.dtype == np.uint8
        # table of the response; empty for linear values
        self.response = self._table(response, automatic)
        self.levels = list[float]()
        self.faults = list[Fault]()
        self.exposures = dict[float, str]()  # by EXIF -> a file
        # whether all channels are equal -> a file
        self.files_by_grey = dict[bool, str]()
        self.files_by_content = dict[int, Path]()
        self.automatic_white = False
        self.newest = 0.0  # time of the newest picture
        self.notes = list[str]()
        if response == "auto" and not self.linear:
            states = ("sRGB", "linear") if automatic else ("linear", "srgb")
            self.notes.append(
                f"pictures of {8 * self.dtype.itemsize} bits are taken as {states[0]}; "
                f"--response {states[1]} if they are not"
            )

    def _table(self, response: str, automatic: bool) -> str:
        """Table of a response that is a word or a file; empty for linear values."""
        if self.linear or (response in ("auto", "linear") and not automatic):
            return ""
        count = 2 ** (8 * self.dtype.itemsize)
        if automatic or response == "srgb":
            return _srgb_table(count)
        file = Path(response)
        require(
            file.is_file(),
            "response",
            "must be auto, srgb, linear, or a file with the response of the camera",
            f"no file {short(response)}",
            "correct the word or the path",
        )
        faults = list[Fault]()
        fields = Fields({"response": file.name}, str(file.parent), faults)
        read_response(file.parent, fields, (0, count - 1))
        require_none(faults)
        return file.read_text(encoding="utf-8")

    def add(
        self,
        file: Path,
        light: str,
        camera: Json,
        inside: Mask | None = None,
    ) -> None:
        """Write a frame, black outside a mask; the first frame of a camera determines
        its size.
        """
        picture = attempt(self.faults, partial(read_picture, file))
        if picture is None:
            return
        height, width, _ = picture.shape
        wanted = f"{camera.setdefault('width', width)} x {camera.setdefault('height', height)}"
        size = f"{width} x {height}"
        is_linear = self.linear and picture.dtype.kind == "f"
        if size != wanted or not (picture.dtype == self.dtype or is_linear):
            rule = f"all pictures must be {wanted} of {self.dtype}"
            finding = f"{size} of {picture.dtype}"
            cure = "export it like the others"
            self.faults.append(Fault(str(file), rule, finding, cure))
            return
        if inside is not None:
            picture[~inside] = 0
        if self.linear:
            used = picture if inside is None else picture[inside]
            self.levels.append(float(np.quantile(used, BRIGHT_QUANTILE)))
        if picture.any():
            is_grey = bool((picture == picture[..., :1]).all())
            self.files_by_grey.setdefault(is_grey, file.name)
            if np.ptp(picture) > 0:
                same = self.files_by_content.setdefault(hash(picture.tobytes()), file)
                if same != file:
                    rule = "every picture must have been taken by itself"
                    cure = "copy the right picture from the camera again"
                    finding = f"a copy of {same.name}"
                    self.faults.append(Fault(str(file), rule, finding, cure))
        target = self.out / f"dome/frames/{light}_{camera['id']}{self.suffix}"
        make_private(target.parent)
        write_frame(target, picture)
        self.newest = max(self.newest, file.stat().st_mtime)
        exposure, automatic_white = exif_exposure(file)
        self.automatic_white |= automatic_white
        if exposure > 0:
            self.exposures.setdefault(exposure, file.name)

    def finish(
        self,
        person: Attributes,
        cameras: list[Json],
        lights: Sequence[Light],
        ids: Sequence[str],
        scan: Path | None = None,
    ) -> None:
        """Write the other files, capture.json last."""
        require_none(self.faults)
        low = min(self.exposures, default=0.0)
        high = max(self.exposures, default=0.0)
        same = high <= EXPOSURE_RATIO * low
        require(
            same or len({light.gain for light in lights}) > 1,
            str(self.first.parent),
            "all pictures must have one exposure, unless intensities of the lights are stated",
            f"by EXIF that of {self.exposures.get(low)} times {high / (low or 1):.3g} "
            f"for {self.exposures.get(high)}",
            "photograph again with the exposure set by hand, or multiply each intensity in "
            "the table of lights by the exposure of its picture",
        )
        if self.automatic_white:
            self.notes.append(
                "the camera chose the white balance of each picture (EXIF): colours are "
                "less certain, and takes differ by it; set it by hand"
            )
        if len(self.files_by_grey) > 1:
            self.notes.append(
                f"{self.files_by_grey[True]} is grey, and others are not: colours are wrong "
                "unless all pictures are of one kind"
            )
        bits = 8 * self.dtype.itemsize
        for camera in cameras:
            camera |= {} if self.linear else {"bit_depth": bits}
            camera |= {"response": "dome/response.csv"} if self.response else {}
        if self.response:
            private_file(self.out / "dome/response.csv").write_text(self.response)
        white = _white_level(max(self.levels, default=1.0))
        if white != 1:
            self.notes.append(
                f"radiance {white:g} is taken as white: takes with another one cannot be compared"
            )
        # what white has depends on it
        records = _light_records(lights, ids, white)
        # different exposures are part of the stated intensities
        exposure = (low or float(self.linear)) if same else 1.0
        exposure *= (
            lights[0].gain * np.pi / WHITE_REFLECTANCE / records[0]["intensity"][0]
        )
        dome = {
            "cameras": cameras,
            "lights": records,
            "relative": True,
            "exposures": [{"id": "e0", "seconds": 1.0}],
            "frames": f"dome/frames/{{light}}_{{camera}}{self.suffix}",
        }
        if exposure > 0:
            dome["relative_exposure"] = exposure
        time = datetime.fromtimestamp(self.newest, UTC)
        record = _record(person, time) | {"dome": "dome/dome.json"}
        if "session" not in person:
            self.notes.append(
                f"session {record['session']} is the time of the newest picture file; "
                "correct it in capture.json if that is no photograph's"
            )
        if scan is not None:
            record["mesh"] = f"scan{scan.suffix.lower()}"
            content = read_regular(scan, MAX_SCAN_BYTES)
            private_file(self.out / record["mesh"]).write_bytes(content)
        for name, value in (("dome/dome.json", dome), ("capture.json", record)):
            text = json.dumps(value, indent=1)
            private_file(self.out / name).write_text(text, encoding="utf-8")


def _table_file(source: Path, given: Path | None) -> Path:
    """The table of the lights."""
    if given is not None:
        return given
    table = source / "lights.csv"
    listed = sorted(source.glob("*.lp"))
    if not table.exists() and len(listed) == 1:
        return listed[0]
    require(
        table.exists(),
        str(source),
        "the directions of the lights must be known: lights.csv, or one .lp file",
        f"{len(listed)} .lp files" if listed else "neither",
        "write a line for each picture: its name, x, y, z; x to the right, y up, z to the "
        "camera; or photograph a mirror ball",
    )
    return table


def _pictures(source: Path) -> tuple[list[Path], list[Path]]:
    """Pictures of a folder, numbers in their names in numerical order, and its masks."""
    require(
        source.is_dir(),
        str(source),
        "the source of an import is a folder",
        "a file" if source.exists() else "nothing",
        "name the folder of the pictures",
    )
    files = [x for x in source.iterdir() if x.suffix.lower() in SUFFIXES]
    files = [x for x in files if x.is_file() and not x.name.startswith(".")]
    require(
        files,
        str(source),
        f"the folder must have pictures ({FORMATS})",
        "none",
        "convert raw and HEIC files to TIFF",
    )
    files = sorted(files, key=_natural)
    masks = [file for file in files if MASK.search(file.stem.lower())]
    return [file for file in files if file not in masks], masks


def _natural(path: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(x), "") if x.isdigit() else (1, 0, x) for x in parts if x]


def _matched(source: Path, files: Sequence[Path], table: Sequence[Light]) -> list[Path]:
    """The pictures of the lights, by name or without its suffix."""
    by_name = {_folded(file.name): file for file in files}
    by_stem = {_folded(file.stem): file for file in files}
    faults = []
    pairs = []
    for light in table:
        name = _folded(light.name)
        file = by_name.get(name) or by_stem.get(name) or by_stem.get(Path(name).stem)
        if file is None:
            rule = "every light of the table must have a picture"
            cure = "correct the name, or remove the line"
            faults.append(Fault(str(source), rule, f"no {short(light.name)}", cure))
        elif file in pairs:
            rule = "a picture must have one light"
            cure = "name pictures with their suffixes, and each in one line"
            faults.append(Fault(str(source), rule, f"{short(file.name)} twice", cure))
        else:
            pairs.append(file)
    require_none(faults)
    require(
        len(pairs) >= MIN_LIGHTS,
        str(source),
        f"normals need pictures under {MIN_LIGHTS} lights or more",
        few_names([file.name for file in pairs]),
        "photograph the subject under more lights",
    )
    return pairs


def _require_directions(place: Path, table: Sequence[Light]) -> list[str]:
    """Require lights in front of the subject and not in a plane; notes on those behind,
    and on those in one place.
    """
    way = np.array([light.vector / np.linalg.norm(light.vector) for light in table])
    behind = [light.name for light in table if light.vector[2] <= 0]
    require(
        len(table) - len(behind) >= MIN_LIGHTS,
        str(place),
        f"{MIN_LIGHTS} lights or more must be in front of the subject, with z above 0",
        f"{len(behind)} of {len(table)} behind it: {few_names(behind)}",
        "write directions from the subject to the lights, with z to the camera",
    )
    spread = np.linalg.eigvalsh(way.T @ way)
    require(
        spread[0] > MIN_SPREAD * spread[2] or not all(x.distant for x in table),
        str(place),
        "directions of the lights must not be in a plane, or nearly equal",
        f"{len(table)} directions that are",
        "add lights elsewhere, or correct the columns x, y, z",
    )
    places = [
        tuple((w if light.distant else light.vector).round(4))
        for light, w in zip(table, way, strict=True)
    ]
    same = [x.name for x, at in zip(table, places, strict=True) if places.count(at) > 1]
    notes = (
        ("lights behind the subject, z not above 0", behind),
        ("pictures under a light in the same place", same),
    )
    return [f"{text}: {few_names(names)}" for text, names in notes if names]


def _typical(files: Sequence[Path]) -> Path:
    """The first picture whose kind most of the first three have."""
    pictures = [read_picture(file) for file in files[:3]]
    kinds = [(picture.shape, picture.dtype) for picture in pictures]
    return files[kinds.index(max(kinds, key=kinds.count))]


def _folded(name: str) -> str:
    """A name without differences that file systems make."""
    return unicodedata.normalize("NFC", name).lower()


def _from_ball(folder: Path, files: Sequence[Path]) -> list[Light]:
    """Directions of the lights of `files`, from pictures of a mirror ball."""
    balls, masks = _pictures(folder)
    require(
        len(masks) == 1 and len(balls) == len(files),
        str(folder),
        "a mirror ball needs one picture *mask*, and one picture for each light",
        f"{len(masks)} masks, {len(balls)} pictures for {len(files)} of the subject",
        "add the missing ones, in the same order",
    )
    outline = ball_outline(_bright(masks[0]))
    return [
        Light(
            file.name,
            distant_light(outline, highlight_centre(read_picture(ball), outline)),
            distant=True,
        )
        for ball, file in zip(balls, files, strict=True)
    ]


def _bright(path: Path) -> Mask:
    """Bright pixels of a mask."""
    picture = read_picture(path)
    return picture.max(axis=-1) > picture.max() / 2


def _mask(path: Path | None, size: tuple[int, int]) -> Mask:
    if path is None:
        return np.ones(size, bool)
    inside = _bright(path)
    require(
        inside.any(),
        str(path),
        "a mask must be bright on the subject",
        "no bright pixel",
        "draw it again",
    )
    require(
        inside.shape == size,
        str(path),
        f"a mask must be as large as the pictures, {size[1]} x {size[0]}",
        f"{inside.shape[1]} x {inside.shape[0]}",
        "draw it again",
    )
    return inside


def _only(files: Sequence[Path]) -> Path | None:
    return files[0] if len(files) == 1 else None


def _ids(names: Sequence[str]) -> list[str]:
    """Identifiers: the names if they can be used and stay distinct, else numbers."""
    stems = [Path(name).stem for name in names]
    usable = all(re.fullmatch(IDENTIFIER.pattern, stem) for stem in stems)
    if usable and len({stem.lower() for stem in stems}) == len(stems):
        return stems
    return [f"l{k:03d}" for k in range(len(names))]


def _distant_camera(width: int, height: int, width_mm: float) -> Json:
    """A camera whose picture is `width_mm` wide at the origin: x right, y up, z to it."""
    focal = CAMERA_DISTANCE_MM * width / width_mm
    return {
        "id": CAMERA,
        "width": width,
        "height": height,
        "K": [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
        "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        "t": [0, 0, CAMERA_DISTANCE_MM],
    }


def _light_records(
    lights: Sequence[Light], ids: Sequence[str], white: float
) -> list[Json]:
    """Lights of dome.json; a facing surface of R_d 0.5 is as bright as `white`."""
    near = [float(np.linalg.norm(x.vector)) for x in lights if not x.distant]
    square = float(np.median(near)) ** 2 if near else 1.0
    irradiance = np.pi * white / WHITE_REFLECTANCE
    usual = float(np.median([light.gain for light in lights]))
    records = []
    for light, name in zip(lights, ids, strict=True):
        key = "direction" if light.distant else "position"
        factor = 1.0 if light.distant else square
        records.append(
            {
                "id": name,
                key: light.vector.tolist(),
                "intensity": [irradiance * factor * light.gain / usual] * 3,
            }
        )
    return records


def _srgb_table(count: int) -> str:
    """Response of sRGB (IEC 61966-2-1): values of the file and relative exposures."""
    value = np.arange(count)
    level = value / (count - 1)
    exposure = np.where(
        level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4
    )
    # the first interval carries no light in the middle of a value
    rows = [
        f"{v},{e:.9g},{e:.9g},{e:.9g}" for v, e in zip(value, exposure, strict=True)
    ]
    return "\n".join(["dn,r,g,b", *rows]) + "\n"


def _olat_files(
    source: Path, lights: Sequence[str], cameras: Sequence[str]
) -> tuple[str, dict[tuple[str, str], Path]]:
    """The pattern of the pictures, and the picture of every light and camera."""
    by_name = {
        _folded(file.relative_to(source).with_suffix("").as_posix()): file
        for file in [*source.glob("*"), *source.glob("*/*")]
        if file.suffix.lower() in SUFFIXES
    }
    views = list(product(lights, cameras))

    def files_of(pattern: str) -> dict[tuple[str, str], Path]:
        files = {}
        for light, camera in views:
            suffix = Path(light).suffix
            is_file = suffix.lower() in SUFFIXES
            name = light.removesuffix(suffix) if is_file else light
            stem = _folded(pattern.format(light=name, camera=camera))
            if file := by_name.get(stem):
                files[light, camera] = file
        return files

    candidates = {pattern: files_of(pattern) for pattern in PATTERNS}
    pattern, files = max(candidates.items(), key=lambda one: len(one[1]))
    for light, camera in views:
        require(
            (light, camera) in files,
            str(source),
            "every light and camera must have a picture: CAMERA/LIGHT, LIGHT/CAMERA, "
            "CAMERA_LIGHT or LIGHT_CAMERA",
            f"{len(files)} of {len(views)}, none of light {light}, camera {camera}",
            "check the names in the tables of lights and cameras",
        )
    return pattern, files


def _record(person: Attributes, time: datetime) -> Json:
    """Content of capture.json."""
    session = time.isoformat(timespec="seconds")
    return {"format": FORMAT, "version": 2, "session": session, **person}


def _require_writable(out: Path, person: Attributes) -> None:
    """Require a record without faults, and a folder that does not exist."""
    require_none(record_faults(_record(person, datetime.now(UTC))))
    require(
        not out.exists() or (out.is_dir() and not any(out.iterdir())),
        str(out),
        "an import writes a new folder",
        "files",
        "name another folder, or remove this one",
    )

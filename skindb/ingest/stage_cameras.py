"""Cameras of light stages: JSON, and text models of COLMAP."""

from collections.abc import Sequence
from pathlib import Path

from scipy.spatial.transform import Rotation

from skindb.errors import Fault, InputError, input_error, require, require_none
from skindb.files import Json, read_regular
from skindb.format.fields import Fields, read_json, short
from skindb.ingest.light_tables import numbers
from skindb.limits import MAX_CAMERAS, MAX_SCAN_BYTES


def read_cameras(source: Path, given: Path | None) -> list[Json]:
    """Cameras of a JSON file, or of the text files of COLMAP."""
    listed = source / "cameras.json"
    path = given or (listed if listed.exists() else source)
    if path.is_dir():
        return _colmap_cameras(path)
    faults = list[Fault]()
    data = read_json(path, faults)
    data = {"cameras": data} if isinstance(data, list) else data
    fields = Fields(data, str(path), faults)
    items = [] if faults else fields.items("cameras", maximum=MAX_CAMERAS)
    for item in items:
        item.text("id")
        for key, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,))):
            item.array(key, shape)
        for key in ("width", "height"):
            if item.has(key):
                item.integer(key, minimum=1)
    require_none(faults)
    keys = ("id", "width", "height", "K", "R", "t", "distortion")
    return [
        {key: item[key] for key in keys if key in item}
        for item in fields.data["cameras"]
    ]


def _colmap_cameras(folder: Path) -> list[Json]:
    """Cameras of cameras.txt and images.txt; images are named after the cameras."""
    tables = {name: folder / f"{name}.txt" for name in ("cameras", "images")}
    require(
        all(path.exists() for path in tables.values()),
        str(folder),
        "cameras must be in cameras.json, or in cameras.txt and images.txt of COLMAP",
        "neither",
        "export the model of COLMAP as text, or write cameras.json",
    )
    place = str(tables["cameras"])
    lenses = {}
    found = list[Json]()
    try:
        lines = {
            name: [
                line.split()
                for line in read_regular(path, MAX_SCAN_BYTES).decode().splitlines()
                if not line.startswith("#")
            ]
            for name, path in tables.items()
        }
        for number, model, width, height, *values in filter(None, lines["cameras"]):
            lens = _colmap_lens(model, [float(value) for value in values], place)
            lenses[number] = {"width": int(width), "height": int(height), **lens}
        place = str(tables["images"])
        rows = iter(lines["images"])
        for words in rows:
            if not words:
                continue
            _, *pose, number, name = words
            w, x, y, z, *t = map(float, pose)
            # of points, x y id; empty without any
            if len(points := next(rows, [])) % 3 or None in numbers(points):
                raise ValueError("an image must be followed by a line of its points")
            camera = Path(name).parts[0] if "/" in name else Path(name).stem
            if camera in [record["id"] for record in found]:
                raise ValueError(f"two images of camera {camera}")
            rotation = Rotation.from_quat([x, y, z, w]).as_matrix().tolist()
            found.append({"id": camera, **lenses[number], "R": rotation, "t": t})
    except InputError:
        raise
    except (ValueError, KeyError) as error:
        raise input_error(
            place,
            "must be a text model of COLMAP, with one image for each camera",
            short(str(error)),
            "export the model as text again",
        ) from None
    return found


def _colmap_lens(model: str, v: Sequence[float], place: str) -> Json:
    """K and distortion k1 k2 p1 p2 k3 of a camera model of COLMAP."""
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        focal, cx, cy, *radial = v
        K = [[focal, 0, cx], [0, focal, cy], [0, 0, 1]]
        lens = [*radial, 0.0, 0.0][:2]
        return {"K": K, "distortion": [*lens, 0.0, 0.0, 0.0]}
    if model in ("PINHOLE", "OPENCV"):
        fx, fy, cx, cy, *lens = v
        K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        return {"K": K, "distortion": [*(lens or [0.0] * 4), 0.0]}
    raise input_error(
        place,
        "the camera model must be SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV",
        model,
        "undistort the pictures with COLMAP",
    )

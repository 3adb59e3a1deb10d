"""Reading scanned meshes (PLY, OBJ) without touching the order of their vertices, and the
part of a scan that is kept.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from scipy.spatial import cKDTree

from skindb.errors import Fault, InputError, input_error, require_none
from skindb.files import open_regular
from skindb.limits import (
    MAX_PLY_TEXT_LINES,
    MAX_SCAN_BYTES,
    MAX_SCAN_FACES,
    MAX_SCAN_HEADER_BYTES,
    MAX_SCAN_VERTICES,
)
from skindb.types import Array, Bytes, Faces, Float64, Index, Mask, finite_rows, float64

MAX_COLOUR = 255  # of the eight bits of a colour of a vertex
CURE = "export the scan again as a triangle mesh in mm (PLY or OBJ)"

# errors of the readers for damaged files, found by changing bytes; MemoryError: an
# absurd size in the header
DAMAGE = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    NameError,
    ArithmeticError,
    MemoryError,
    RecursionError,
)


class DamageError(ValueError):
    """Damage of a mesh file that its text describes; errors of the readers describe
    their own code.
    """


@dataclass(frozen=True)
class Scan:
    """A mesh as it lies in its file: regions and landmarks refer to vertices by their
    number there.
    """

    vertices: Float64  # (v, 3) mm
    faces: Index  # (f, 3)
    colours: Bytes | None = None  # (v, 3) of a PLY file with colours of 8 bits, sRGB


def read_scan(path: str | Path) -> Scan:
    """Read a PLY (text or binary) or OBJ file; polygons are split into triangles,
    textures are not read.

    Parameters
    ----------
    path
        File in mm, subject frame.

    Returns
    -------
    Scan
        All vertices in the order of the file, including those that no face uses.

    Raises
    ------
    InputError
        With every fault found: unreadable, no triangles, a vertex that is not finite, a
        face without its vertex.
    """
    file = Path(path)
    reader = {".ply": _read_ply, ".obj": _read_obj}.get(file.suffix.lower())
    if reader is None:
        rule = "a scan must be a .ply or .obj file"
        raise _fault(file, rule, file.suffix or "no suffix")
    try:
        with open_regular(file, MAX_SCAN_BYTES) as stream:
            scan = reader(stream)
    except InputError:
        raise
    except OSError as error:
        finding = error.strerror or str(error)
        raise _fault(file, "the scan must be readable", finding) from error
    except DAMAGE as error:
        rule = "the scan must be a complete mesh file"
        raise _fault(file, rule, _damage(error)) from error
    require_none(_faults(str(file), scan.vertices, scan.faces))
    return scan


def _damage(error: Exception) -> str:
    """Description of the damage of a mesh file, for a message."""
    if isinstance(error, OverflowError):
        return "a number beyond 64 bits"
    if isinstance(error, DamageError):
        return str(error)
    return "one that is cut off or damaged"


def _fault(file: Path, rule: str, finding: str) -> InputError:
    return input_error(str(file), rule, finding, CURE)


def _faults(file: str, vertices: Array, faces: Index) -> list[Fault]:
    faults = []
    if len(faces) == 0:
        finding = f"{len(vertices)} vertices and no face"
        faults.append(Fault(file, "a scan must have triangles", finding, CURE))
    bad = np.flatnonzero(~finite_rows(vertices))
    if len(bad):
        finding = f"{len(bad)} that are not finite, first vertex {bad[0]}"
        faults.append(Fault(file, "vertices must be finite numbers", finding, CURE))
    wrong = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
    if len(wrong):
        finding = f"{len(wrong)} other faces, first face {wrong[0]}, for {len(vertices)} vertices"
        faults.append(
            Fault(file, "faces must refer to vertices of the file", finding, CURE)
        )
    return faults


def _read_ply(stream: BinaryIO) -> Scan:
    _require_counts(stream)
    # takes longer to import than most commands run
    from trimesh.exchange.ply import load_ply

    # fix_texture would split vertices along texture seams and so renumber them
    content = load_ply(stream, fix_texture=False, skip_materials=True)
    vertices = float64(content.get("vertices", np.zeros((0, 3))))
    faces = np.asarray(content.get("faces", np.zeros((0, 3))), np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise DamageError(f"vertices of shape {vertices.shape}")
    if faces.ndim == 2 and faces.shape[1] != 3:
        faces = _triangulated(list(faces), vertices)
    colours = np.asarray(content.get("vertex_colors", ()))
    is_coloured = colours.shape[:1] == vertices.shape[:1] and colours.dtype.kind in "iu"
    if not is_coloured or not ((colours >= 0) & (colours <= MAX_COLOUR)).all():
        return Scan(vertices, faces.reshape(-1, 3))
    return Scan(vertices, faces.reshape(-1, 3), colours[:, :3].astype(np.uint8))


def _require_counts(stream: BinaryIO) -> None:
    """Require that the counts in the header of a PLY file fit into the file and into memory."""
    size = stream.seek(0, 2)
    stream.seek(0)
    header, end, _ = stream.read(MAX_SCAN_HEADER_BYTES).partition(b"end_header")
    if not end:
        raise DamageError("a header without its end")
    total = 0
    for line in header.splitlines():
        word, *rest = line.split()[:3] or [b""]
        if word != b"element":
            continue
        name = rest[0]
        count = int(rest[1])
        limit = {b"vertex": MAX_SCAN_VERTICES, b"face": MAX_SCAN_FACES}.get(name, size)
        total += count
        if not 0 <= count <= min(limit, size):
            raise DamageError(
                f"a header that states {count:,} elements {name.decode('latin-1')!a}"
            )
    if b"ascii" in header:
        blocks = iter(lambda: stream.read(1 << 20), b"")
        lines = sum(block.count(b"\n") + block.count(b"\r") for block in blocks)
        if lines > MAX_PLY_TEXT_LINES:
            raise DamageError(f"{lines:,} lines of text: write a binary PLY file")
        stream.seek(len(header) + len(end))
        rows = sum(bool(line.strip()) for line in stream)
        if rows != total:  # a surplus or missing vertex would shift all that follow
            raise DamageError(f"{rows:,} lines for {total:,} elements")
    stream.seek(0)


def _read_obj(stream: BinaryIO) -> Scan:
    """Positions and faces only: general readers split or reorder vertices where texture
    coordinates differ.
    """
    vertices = array("d")
    corners = array("q")
    sizes = array("q")
    for word, rest in _obj_lines(stream):
        if word == b"v":
            point = [float(x) for x in rest.split()[:3]]
            if len(point) != 3:
                raise DamageError("a vertex without three coordinates")
            vertices.extend(point)
        elif word == b"f":
            index = [int(corner.partition(b"/")[0]) for corner in rest.split()]
            # numbers start at 1; negative ones count back from the vertices so far
            corners.extend(i - 1 if i > 0 else len(vertices) // 3 + i for i in index)
            sizes.append(len(index))
        if len(vertices) > 3 * MAX_SCAN_VERTICES or len(corners) > 3 * MAX_SCAN_FACES:
            raise DamageError(
                f"more than {MAX_SCAN_VERTICES:,} vertices or {MAX_SCAN_FACES:,} triangles"
            )
    points = np.array(vertices, np.float64).reshape(-1, 3)
    numbers = np.array(corners, np.int64)
    if all(size == 3 for size in sizes):
        return Scan(points, numbers.reshape(-1, 3))
    polygons = np.split(numbers, np.cumsum(sizes)[:-1])
    return Scan(points, _triangulated(polygons, points))


def _obj_lines(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """First word and rest of each line; those that end in a backslash continue in the next one."""
    begun = b""
    for raw in stream:
        for part in raw.splitlines():
            line = begun + part
            begun = line[:-1] + b" " if line.endswith(b"\\") else b""
            if not begun:
                word, _, rest = line.strip().partition(b" ")
                yield word, rest
    word, _, rest = begun.strip().partition(b" ")
    yield word, rest


def _triangulated(polygons: list[Index], points: Array) -> Index:
    """Triangles (f, 3) of polygons, quads along their shorter diagonal."""
    triangles = []
    for polygon in polygons:
        corners = polygon
        if len(polygon) == 4 and _second_is_shorter(polygon, points):
            corners = np.roll(polygon, -1)
        triangles += [
            [corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)
        ]
    return np.array(triangles, np.int64).reshape(-1, 3)


def _second_is_shorter(quad: Index, points: Array) -> bool:
    """Whether corners 1 and 3 are nearer than 0 and 2: a quad cut along its shorter
    diagonal does not fold.
    """
    if min(quad) < 0 or max(quad) >= len(points):
        return False  # reported later
    a, b, c, d = points[quad]
    return bool(np.linalg.norm(b - d) < np.linalg.norm(a - c))


@dataclass(frozen=True)
class Crop:
    """Limits of the part of a scan that is kept; all of them apply."""

    low: tuple[float, float, float] | None = None  # corner of a box along the axes, mm
    high: tuple[float, float, float] | None = None
    reach_mm: float | None = None  # largest distance from the nearest landmark

    def __post_init__(self) -> None:
        """Check that the limits are not empty."""
        is_box = self.low is not None and self.high is not None
        if is_box and not np.less(np.array(self.low), np.array(self.high)).all():
            rule = "its lower corner must lie below the higher one, in mm"
            raise input_error(
                "crop", rule, f"{self.low} and {self.high}", "exchange them"
            )
        if self.reach_mm is not None and not self.reach_mm > 0:
            rule = "its reach must be positive, in mm"
            raise input_error("crop", rule, str(self.reach_mm), "give a positive one")


def crop_faces(
    vertices: Array, faces: Faces, crop: Crop, *, landmarks: Array | None = None
) -> Mask:
    """Mask (f,) of the faces whose corners are all kept, so that none extends beyond the box.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3).
    crop
        Limits.
    landmarks
        (k, 3) mm, needed where the crop has a reach.
    """
    points = float64(vertices)
    inside = np.ones(len(points), bool)
    if crop.low is not None:
        inside &= (points >= crop.low).all(axis=1)
    if crop.high is not None:
        inside &= (points <= crop.high).all(axis=1)
    if crop.reach_mm is not None:
        if landmarks is None or not len(landmarks):
            raise ValueError("a crop around the landmarks needs landmarks")
        inside &= cKDTree(landmarks).query(points)[0] <= crop.reach_mm
    return np.asarray(inside[faces].all(axis=1))

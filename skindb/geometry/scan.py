"""Reading scanned meshes (PLY, OBJ) without touching the order of their vertices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError

CURE = "export the scan again as a triangle mesh in mm (PLY or OBJ)"


@dataclass(frozen=True)
class Scan:
    """A mesh as it lies in its file: regions and landmarks refer to vertices by their number there."""

    vertices: NDArray[np.float64]  # (v, 3) mm
    faces: NDArray[np.int64]  # (f, 3)


def read_scan(path: str | Path) -> Scan:
    """Read a PLY (text or binary) or OBJ file; polygons are cut into triangles, textures are not read.

    Parameters
    ----------
    path
        File in mm, subject frame.

    Returns
    -------
    Scan
        Vertices in the order and number of the file, also those that no face uses.

    Raises
    ------
    InputError
        With every fault found: unreadable, no triangles, a vertex that is not finite, a face without its vertex.
    """
    file = Path(path)
    reader = {".ply": _read_ply, ".obj": _read_obj}.get(file.suffix.lower())
    if reader is None:
        raise _fault(file, "a scan is a .ply or .obj file", f"{file.suffix or 'no suffix'}")
    try:
        vertices, faces = reader(file)
    except OSError as error:
        raise _fault(file, "the scan must be readable", error.strerror or str(error)) from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, NameError) as error:
        raise _fault(file, "the scan must be a whole mesh file", f"{type(error).__name__}: {error}") from error
    if faults := _faults(file, vertices, faces):
        raise InputError(faults)
    return Scan(vertices, faces)


def _fault(file: Path, rule: str, found: str) -> InputError:
    return InputError(Fault(str(file), rule, found, CURE))


def _faults(file: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> list[Fault]:
    faults = []
    if len(faces) == 0:
        faults.append(Fault(str(file), "a scan has triangles", f"{len(vertices)} vertices and no face", CURE))
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        found = f"{len(bad)} that are not, first vertex {bad[0]}"
        faults.append(Fault(str(file), "vertices are finite numbers", found, CURE))
    wrong = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
    if len(wrong):
        found = f"{len(wrong)} that do not, first face {wrong[0]}, of {len(vertices)} vertices"
        faults.append(Fault(str(file), "faces name vertices of the file", found, CURE))
    return faults


def _read_ply(file: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    from trimesh.exchange.ply import load_ply

    with file.open("rb") as stream:
        # fix_texture would split vertices along texture seams and so renumber them
        content = load_ply(stream, fix_texture=False, skip_materials=True)
    vertices = np.asarray(content.get("vertices", np.zeros((0, 3))), np.float64)
    faces = np.asarray(content.get("faces", np.zeros((0, 3))), np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices of shape {vertices.shape}")
    return vertices, _triangulated([*faces] if faces.ndim == 2 and faces.shape[1] != 3 else faces, vertices)


def _read_obj(file: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Positions and faces only: general readers split or reorder vertices where texture coordinates differ."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    # continued lines end in a backslash
    text = file.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for line in text.splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "v":
            vertices.append([float(x) for x in rest.split()[:3]])
        elif word == "f":
            index = [int(corner.partition("/")[0]) for corner in rest.split()]
            # numbers start at 1; negative ones count back from the vertices so far
            polygons.append([i - 1 if i > 0 else len(vertices) + i for i in index])
    if any(len(vertex) != 3 for vertex in vertices):
        raise ValueError("a vertex without three coordinates")
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return points, _triangulated(polygons, points)


def _triangulated(
    polygons: list[list[int]] | list[NDArray[np.int64]] | NDArray[np.int64], points: NDArray[np.float64]
) -> NDArray[np.int64]:
    if isinstance(polygons, np.ndarray):
        return polygons.reshape(-1, 3)
    cut = [np.roll(p, -1) if len(p) == 4 and _second_is_shorter(p, points) else p for p in polygons]
    fans = [[p[0], p[i], p[i + 1]] for p in cut for i in range(1, len(p) - 1)]
    return np.array(fans, np.int64).reshape(-1, 3)


def _second_is_shorter(quad: Any, points: NDArray[np.float64]) -> bool:
    """Whether corners 1 and 3 are nearer than 0 and 2: a quad cut along its shorter diagonal does not fold."""
    if min(quad) < 0 or max(quad) >= len(points):
        return False  # told later
    a, b, c, d = points[np.asarray(quad)]
    return bool(np.linalg.norm(b - d) < np.linalg.norm(a - c))

"""Head model files: any mesh or npz with vertices and faces, and the npz of a morphable
population.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from skindb.errors import Fault, InputError
from skindb.geometry.mesh import vertex_normals
from skindb.geometry.subdivide import subdivide
from skindb.virtual.face_regions import REGIONS
from skindb.virtual.head import Head
from skindb.virtual.person import Person

Array = NDArray[np.float64]
# names of regions in other models -> names in skindb
SAME_REGION = {
    "brow": "forehead",
    "upper_lip": "beard",
    "jaw": "beard",
    "neck_beard": "beard",
}
ETHNICITY = {
    "european": "caucasian",
    "east_asian": "asian",
    "african": "african",
    "south_asian": "caucasian",
}
# rounds of averaging over neighbours to convert labels to smooth memberships
SOFTEN = 6


@dataclass(frozen=True)
class HeadModel:
    """Contents of a head model file; modes are absent in a plain head."""

    vertices: Array  # (n, 3) mm
    faces: NDArray[np.int64]  # (m, 3)
    landmarks: Mapping[str, int] = field(default_factory=dict)  # name -> vertex
    # name -> vertices
    regions: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    identity: Array | None = None  # (modes, n, 3) mm per standard deviation
    # name -> (modes,) coefficients of a group's mean
    traits: Mapping[str, Array] = field(default_factory=dict)


def load_head(path: Path) -> HeadModel:
    """Read a head model.

    Parameters
    ----------
    path
        .npz with `vertices` and `faces` (optionally `landmark_names`,
        `landmark_vertex`, `region`, `region_names`), the npz of a morphable population
        (`v0`, `quads`, `id_q`, `id_scale`, ...), or a mesh file (.ply, .obj).

    Returns
    -------
    HeadModel
        Raises `InputError` for a file that is none of these.
    """
    if not path.is_file():
        raise InputError(Fault(str(path), "head model file must exist", "no file"))
    if path.suffix.lower() != ".npz":
        mesh = trimesh.load(path, process=False, maintain_order=True, force="mesh")
        return _checked(
            path,
            HeadModel(
                np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
            ),
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (BadZipFile, ValueError, OSError) as error:
        raise InputError(
            Fault(str(path), "head model must be a readable npz archive", str(error))
        ) from error
    if "v0" in arrays:
        return _checked(path, _population(arrays))
    if not {"vertices", "faces"} <= arrays.keys():
        found = ", ".join(sorted(arrays)) or "nothing"
        raise InputError(
            Fault(
                str(path),
                "head model needs the arrays vertices and faces, or v0 and quads",
                found,
            )
        )
    return _checked(path, _plain(arrays))


def _checked(path: Path, model: HeadModel) -> HeadModel:
    faults = []
    if (
        model.vertices.ndim != 2
        or model.vertices.shape[1:] != (3,)
        or not np.isfinite(model.vertices).all()
    ):
        faults.append(
            Fault(
                str(path),
                "vertices must be finite points (n, 3) in mm",
                str(model.vertices.shape),
            )
        )
    if (
        not len(model.faces)
        or model.faces.min() < 0
        or model.faces.max() >= len(model.vertices)
    ):
        faults.append(
            Fault(
                str(path),
                "faces must be triangles of existing vertices",
                f"{len(model.faces)} faces",
            )
        )
    if faults:
        raise InputError(faults)
    return model


def _plain(a: Mapping[str, NDArray[Any]]) -> HeadModel:
    names = a.get("landmark_names", np.array([]))
    vertex = a.get("landmark_vertex", np.array([]))
    landmarks = {str(n): int(v) for n, v in zip(names, vertex, strict=True)}
    return HeadModel(
        a["vertices"].astype(float), a["faces"].astype(np.int64), landmarks, _regions(a)
    )


def _population(a: Mapping[str, NDArray[Any]]) -> HeadModel:
    """Mean shape, identity modes, coefficients of group means; quads are split, eye and
    mouth caps closed.
    """
    faces = a["quads"].astype(np.int64)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    if "caps" in a:
        faces = np.concatenate([faces, a["caps"].astype(np.int64)])
    identity = (
        a["id_q"] * a["id_scale"][:, None, None].astype(float) if "id_q" in a else None
    )
    traits = {
        str(n): c.astype(float)
        for n, c in zip(a.get("trait_keys", ()), a.get("trait_coef", ()), strict=True)
    }
    landmarks = {
        str(n): int(v)
        for n, v in zip(a.get("lm20_names", ()), a.get("lm20", ()), strict=True)
    }
    return HeadModel(
        a["v0"].astype(float), faces, landmarks, _regions(a), identity, traits
    )


def _regions(a: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.int64]]:
    if "region" not in a:
        return {}
    out = {
        str(name): np.flatnonzero(a["region"] == i)
        for i, name in enumerate(a["region_names"])
    }
    if "beard" in a:
        out["beard"] = np.flatnonzero(a["beard"])
    return out


def head_of_file(path: Path, person: Person) -> tuple[Head, Head]:
    """The true head (one Loop subdivision) of `person` from a model file, and the scan
    in the topology of the file.

    For a population, the person's seed draws the identity, and gender, ancestry and age
    shift it; a plain head is used unchanged.
    """
    model = load_head(path)
    base = _person_shape(model, person)
    vertices, faces, matrix = subdivide(base, model.faces, 1)
    count = len(base)
    soft = _membership(model)
    normals = vertex_normals(vertices, faces)
    true = Head(
        vertices,
        faces,
        normals,
        {name: vertices[v] for name, v in model.landmarks.items()},
        {name: np.asarray(matrix @ values) for name, values in soft.items()},
    )
    # Loop subdivision keeps the old vertices first: the scan has the file's triangles
    # on the true surface
    return true, Head(
        vertices[:count], model.faces, normals[:count], true.landmarks, soft
    )


def _person_shape(model: HeadModel, person: Person) -> Array:
    if model.identity is None:
        return model.vertices
    coefficient = 0.8 * person.stream(1).standard_normal(len(model.identity))
    age = "child" if person.age < 15 else "old" if person.age > 60 else "young"
    group = model.traits.get(f"{ETHNICITY[person.ancestry]}_{person.gender}_{age}")
    if group is not None:
        coefficient = coefficient + 0.6 * group
    return np.asarray(model.vertices + np.tensordot(coefficient, model.identity, 1))


def _membership(model: HeadModel) -> dict[str, Array]:
    """Smooth memberships of the regions that skindb uses, from the labels of the file."""
    n = len(model.vertices)
    edge = np.concatenate(
        [model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]]
    )
    near = sparse.coo_matrix(
        (np.ones(len(edge)), (edge[:, 0], edge[:, 1])), (n, n)
    ).tocsr()
    near = near + near.T + sparse.identity(n)
    near.data[:] = 1
    mean = sparse.diags(1 / np.asarray(near.sum(axis=1)).ravel()) @ near
    fields = np.zeros((n, len(REGIONS)))
    for name, ids in model.regions.items():
        ours = SAME_REGION.get(name, name)
        if ours in REGIONS:
            fields[ids, REGIONS.index(ours)] = 1
    for _ in range(SOFTEN):
        fields = mean @ fields
    return {name: fields[:, i] for i, name in enumerate(REGIONS)}

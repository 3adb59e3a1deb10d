"""Models of faces as files with the field names of AlbedoMM (Smith et al. 2020)."""

from pathlib import Path
from typing import Any

import numpy as np
from xarray import Dataset

from skindb.analysis.face_models import BLOCKS, LOG, POSITION, block_rows, face_at
from skindb.errors import input_error
from skindb.files import private_file
from skindb.schema import variables


def write_face_model(model: Dataset, path: Path) -> None:
    """Write a model with the field names of AlbedoMM (Smith et al. 2020), as HDF5
    (which needs h5py) or .npz.

    All groups have the same scores. Albedo and sigma_tr are linear to first order, and
    gloss is repeated in three channels. Columns of `pcaBasis` have unit length in each
    group; they are orthogonal in all groups together. Scores of subjects are not
    written.

    Raises
    ------
    InputError
        Without h5py, or if the model has no shape.
    """
    arrays = _exported(model)
    if path.suffix == ".npz":
        np.savez(private_file(path), **arrays)
        return
    try:
        import h5py
    except ImportError:
        cure = "pip install 'skindb[hdf5]', or write .npz"
        raise input_error(str(path), "needs h5py", "none", cure) from None
    with h5py.File(private_file(path), "w") as file:
        for name, values in arrays.items():
            file[name] = values
        for group in file.values():
            kind = {"name": "skindb", "datasetType": "POLYGON_MESH"}
            group["representer"].attrs.update(kind)


def _exported(model: Dataset) -> dict[str, Any]:
    """Path in a file of AlbedoMM -> array."""
    mean = face_at(model)
    used = np.isfinite(mean[POSITION].values).all(axis=-1)
    number = np.where(used, np.cumsum(used).reshape(used.shape) - 1, -1)
    left = [number[:-1, :-1], number[1:, :-1], number[:-1, 1:]]
    right = [number[:-1, 1:], number[1:, :-1], number[1:, 1:]]
    cells = np.hstack([np.reshape(half, (3, -1)) for half in (left, right)])
    cells = cells[:, (cells >= 0).all(axis=0)]
    arrays: dict[str, Any] = {}
    for name in model["block"].values.tolist():
        rows = block_rows(model["quantity"].values.tolist(), name)
        block = BLOCKS[name]
        values = np.dstack([mean[block.variable].values])[used] * np.ones(3)
        slope = values if block.quantities[0].startswith(LOG) else 1.0
        modes = model[variables.FACE_MODE].values[:, rows][..., used]
        basis = (modes.transpose(0, 2, 1) * np.ones(3) * slope).reshape(len(modes), -1)
        length = np.linalg.norm(basis, axis=1)
        scale = model[variables.FACE_SCALE].values[rows][0] * slope
        noise = model[variables.NOISE_VARIANCE].values * np.mean(scale**2)
        arrays |= {
            f"{block.exported}/version/majorVersion": np.int32(0),
            f"{block.exported}/version/minorVersion": np.int32(9),
            f"{block.exported}/model/mean": np.float32(values.ravel()),
            f"{block.exported}/model/pcaBasis": np.float32(basis.T / length),
            f"{block.exported}/model/pcaVariance": np.float32(length**2),
            f"{block.exported}/model/noiseVariance": np.full(1, noise, np.float32),
            f"{block.exported}/representer/points": mean[POSITION].values[used].T,
            f"{block.exported}/representer/cells": np.int32(cells),
        }
    return arrays

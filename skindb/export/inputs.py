"""What an export needs of a model: checks, the size of its maps, and the description of an
edit.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema import check
from skindb.schema.plain import plain

REQUIRED = (
    "surfel_position",
    "surfel_normal",
    "surfel_uv",
    "shading_normal",
    "diffuse_reflectance",
    "basis_weight",
    "fit_status",
    "refractive_index",
)
# texels per spacing of surfels; more would only show interpolation, less would lose
# detail
TEXELS_PER_SPACING = 1.5
# of the default
MIN_SIZE = 64
MAX_SIZE = 8192
# of memory while maps of 30 channels are computed (measured: 190)
BYTES_PER_TEXEL = 220


def texture_size(model: xr.DataTree) -> int:
    """Texels along each side of maps without loss: 1.5 per spacing of the surfels,
    rounded up to a power of two.
    """
    uv = model["fitted"].to_dataset()["surfel_uv"].values
    triangles = model["mesh"].to_dataset()["triangle"].values
    corners = uv.astype(np.float64)[triangles]
    edge = np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1))
    texels = TEXELS_PER_SPACING / max(float(edge), 1e-6)
    return int(np.clip(2 ** np.ceil(np.log2(texels)), MIN_SIZE, MAX_SIZE))


def chosen_size(model: xr.DataTree, size: int | None) -> int:
    """Texels along each side of maps: `size`, or `texture_size` for None.

    Raises
    ------
    InputError
        If `size` is not positive, or the maps need more memory than is free.
    """
    side = texture_size(model) if size is None else size
    if side < 1:
        raise InputError(Fault("size", "must be positive", str(side), "omit it"))
    needed = BYTES_PER_TEXEL * side**2
    free = _free_memory()
    if needed > free:
        rule = f"maps of {side} x {side} texels need {needed / 1e9:.1f} GB of memory"
        cure = "choose a smaller size"
        raise InputError(
            Fault(
                "size",
                rule,
                f"{free / 1e9:.1f} GB",
                f"{cure}, for example {texture_size(model)}",
            )
        )
    return side


def _free_memory() -> float:
    """Bytes that are available without swapping; infinite where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return np.inf
    available = [
        float(line.split()[1]) * 1024
        for line in lines
        if line.startswith("MemAvailable:")
    ]
    return available[0] if available else np.inf


def required(model: xr.DataTree) -> xr.Dataset:
    """The fitted surfels of a model, checked to have what maps and textures need.

    Raises
    ------
    InputError
        If variables are missing, or the texture coordinates are not finite or cover no area.
    """
    fitted = model["fitted"].to_dataset()
    check(fitted, REQUIRED, where="fitted")
    corner = (
        fitted["surfel_uv"]
        .values[model["mesh"].to_dataset()["triangle"].values]
        .astype(np.float64)
    )
    if not np.isfinite(corner).all() or not np.ptp(corner, axis=1).any():
        rule = "texture coordinates must be finite and cover an area"
        cure = "ingest and fit the capture again"
        fault = (
            "values that are not finite"
            if not np.isfinite(corner).all()
            else "no triangle with an area"
        )
        raise InputError(Fault("fitted[surfel_uv]", rule, fault, cure))
    return fitted


def describe_edit(attrs: Mapping[Any, Any]) -> dict[str, Any] | None:
    """Origin of an edited model, the edit, and whose consent covers it; None if the
    model was not edited.
    """
    if "edit" not in attrs:
        return None
    made_from = {
        str(record["kind"]): record.get("generation")
        for record in attrs.get("inputs", [])
    }
    whose = str(attrs.get("take", attrs.get("subject", "a subject")))
    description = {
        "from": whose,
        "model_generation": made_from.get("model"),
        "by": dict(attrs["edit"]),
        "traits_generation": made_from.get("population"),
        "distance": attrs.get("edit_distance"),
        "consent": f"This face was not measured. It was computed from the data of {whose}, "
        "with traits of other "
        f"subjects added. The consent of {whose} covers it. Whoever shows it must "
        "state that it was edited.",
    }
    return dict(plain(description))

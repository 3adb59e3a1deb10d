"""What an export needs of a model: checks, the size of its maps, the description of an edit, and
the mean free path for programs without the dipole.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.files import Json, plain
from skindb.optics.diffusion import dipole_s
from skindb.render.surfels import with_matt_surfels
from skindb.schema import check, fitted_of, variables
from skindb.types import Array, float64, lengths

REQUIRED = (
    variables.SURFEL_POSITION,
    variables.SURFEL_NORMAL,
    variables.SURFEL_UV,
    variables.SHADING_NORMAL,
    variables.DIFFUSE_REFLECTANCE,
    variables.BASIS_WEIGHT,
    variables.FIT_STATUS,
    variables.REFRACTIVE_INDEX,
)
# texels per spacing of surfels; more would only show interpolation, less would lose
# detail
TEXELS_PER_SPACING = 1.5
# of the default
MIN_SIZE = 64
MAX_SIZE = 8192
# of memory while maps of 30 channels are computed (measured: 190)
BYTES_PER_TEXEL = 220
# mean free path of the walk over that of the dipole, s / sigma_tr, is this constant
# plus this factor times R_d. Fitted to the edge of a shadow for R_d from 0.02 to 0.9
# and an index of 1.3, within 3 %; within 20 % for an index of 1.45
MEAN_FREE_PATH_OFFSET = 1.7
MEAN_FREE_PATH_PER_ALBEDO = 0.4


def texture_size(model: xr.DataTree) -> int:
    """Texels along each side of maps without loss: 1.5 per spacing of the surfels,
    rounded up to a power of two, and at least those of the detail.
    """
    uv = fitted_of(model)[variables.SURFEL_UV].values
    triangles = model["mesh"].dataset[variables.TRIANGLE].values
    corners = uv.astype(float)[triangles]
    edge = np.median(lengths(corners - np.roll(corners, 1, axis=1)))
    texels = TEXELS_PER_SPACING / max(float(edge), 1e-6)
    if "detail" in model.children:
        texels = max(texels, model["detail"].sizes["v"])
    return int(np.clip(2 ** np.ceil(np.log2(texels)), MIN_SIZE, MAX_SIZE))


def chosen_size(model: xr.DataTree, size: int | None) -> int:
    """Texels along each side of maps: `size`, or `texture_size` for None.

    Raises
    ------
    InputError
        If `size` is not positive, or the maps need more memory than is free.
    """
    side = texture_size(model) if size is None else size
    require(side > 0, "size", "must be positive", str(side), "omit it")
    needed = BYTES_PER_TEXEL * side**2
    free = _free_memory()
    require(
        needed <= free,
        "size",
        f"maps of {side} x {side} texels need {needed / 1e9:.1f} GB of memory",
        f"{free / 1e9:.1f} GB",
        f"choose a smaller size, for example {texture_size(model)}",
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
    fitted = fitted_of(model)
    check(fitted, REQUIRED, where="fitted")
    triangles = model["mesh"].dataset[variables.TRIANGLE].values
    corner = fitted[variables.SURFEL_UV].values[triangles].astype(float)
    is_finite = np.isfinite(corner).all()
    require(
        is_finite and np.ptp(corner, axis=1).any(),
        "fitted[surfel_uv]",
        "texture coordinates must be finite and cover an area",
        "no triangle with an area" if is_finite else "values that are not finite",
        "ingest and fit the capture again",
    )
    return with_matt_surfels(fitted)


def describe_edit(attrs: Mapping[Any, Any]) -> Json | None:
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


def mean_free_path(diffuse: Array, sigma_tr: Array, *, eta: float) -> Array:
    """Mean free path [mm] with which a random walk spreads light as far as the dipole
    with R_d and sigma_tr.

    The walk is that of OpenPBR and of similar renderers: isotropic scattering in a
    half-space without a boundary, whose albedo is chosen such that R_d of the light
    returns. It has another mean free path than the dipole, because light that has
    entered is reflected at the boundary of the dipole, and because the dipole has no
    light near its entry.

    Parameters
    ----------
    diffuse, sigma_tr
        R_d, and mm^-1, of one shape.
    eta
        Refractive index of the skin.
    """
    s, _ = dipole_s(diffuse, eta=eta)
    return (
        (MEAN_FREE_PATH_OFFSET + MEAN_FREE_PATH_PER_ALBEDO * float64(diffuse))
        * s
        / sigma_tr
    )

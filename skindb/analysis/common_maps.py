"""Maps of a model in the common (u, v) of all registered takes (Weyrich et al. 2005,
section 10.2).
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.geometry.texture import atlas_values, push_pull, rasterise_atlas
from skindb.render.texels import surfel_texels, texel_codes
from skindb.schema import TexelStatus, Use, dataset, names_of

SIZE = 512  # texels along each side of the stored maps of a registration


def common_maps(
    model: xr.DataTree, registered: xr.Dataset, *, size: int = SIZE
) -> xr.Dataset:
    """Albedo, surface reflectance and translucency of one take as maps in the common (u, v).

    Parameters
    ----------
    model
        Version of kind "model".
    registered
        Registration of this model, with `common_uv`.
    size
        Texels along each side; texel (i, j) has its centre at v = (i + 0.5) / size, u =
        (j + 0.5) / size.

    Returns
    -------
    Dataset
        (v, u, ...) `texel_diffuse_reflectance` with its total error,
        `texel_surface_reflectance`, `texel_sigma_tr`, `texel_status` (whether a value
        is trusted, and why not) and `texel_coverage`. Inside the face, values that were
        not measured are interpolated from the surrounding texels; outside they are NaN.
    """
    fitted = model["fitted"].to_dataset().load()
    triangles = model["mesh"].to_dataset()["triangle"].values
    uv = registered["common_uv"].values
    codes = surfel_texels(fitted)
    raster = rasterise_atlas(uv, triangles, size)
    status = texel_codes(codes, triangles, *raster)
    outside = status == TexelStatus.OUTSIDE
    maps: dict[str, np.ndarray] = {}
    coverage = np.zeros((size, size), np.float32)
    for name in names_of(Use.MAPPED):
        if name not in fitted:
            continue
        values = fitted[name].values.reshape(len(codes), -1).astype(np.float32)
        trust = (
            (codes == TexelStatus.MEASURED) & np.isfinite(values).all(axis=1)
        ).astype(np.float32)
        image, found = atlas_values(np.nan_to_num(values), trust, uv, triangles, raster)
        filled = (
            push_pull(image, found)[0] if trust.any() else np.full_like(image, np.nan)
        )
        filled = np.where(outside[..., None], np.float32(np.nan), filled)
        maps[f"texel_{name}"] = filled if fitted[name].ndim == 2 else filled[..., 0]
        if name == "diffuse_reflectance":
            coverage = np.where(outside, np.float32(0), found)
    if "even_reflection_limit" in fitted:
        maps["even_reflection_limit"] = fitted["even_reflection_limit"].values
    return dataset(
        maps | {"texel_status": status, "texel_coverage": coverage},
        coords={"channel": ["R", "G", "B"]},
    )

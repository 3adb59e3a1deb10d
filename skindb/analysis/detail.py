"""Transfer of fine detail, such as moles, freckles and follicles, between faces
(Weyrich et al. 2005, section 11).
"""

import math

import numpy as np
from scipy.ndimage import gaussian_filter
from xarray import Dataset, DataTree

from skindb.analysis.edit import surviving, with_albedo
from skindb.analysis.regions import common_landmarks, map_regions
from skindb.analysis.summary import common_maps
from skindb.analysis.texture import SIZE, at_surfels, log_albedo
from skindb.errors import require
from skindb.numerics.texture import Image, build, level_fractions, reconstruct
from skindb.schema import variables
from skindb.schema.consent import honour_consent
from skindb.schema.label import FACE, take_attrs
from skindb.types import Array, Mask

# mm, default wavelength of the coarsest detail transferred: freckles, small moles,
# follicles
COARSEST = 8.0
EDGE = 2.0  # mm, standard deviation of the Gaussian that blends the edge of the region


def transfer_detail(
    model: DataTree,
    source: DataTree,
    *,
    registered: Dataset,
    source_registered: Dataset,
    region: str | Mask = FACE,
    coarsest: float = COARSEST,
    size: int = SIZE,
) -> DataTree:
    """Copy of a model that has the fine albedo detail of another take within a region.

    The bands of the steerable pyramid of log albedo in the common (u, v), up to a
    wavelength, are replaced by those of the source; coarser bands and the mean colour
    are kept. Nothing changes where the source was not measured.

    Parameters
    ----------
    model, source
        Versions of kind "model": the face that is edited, and the face that provides the detail.
    registered, source_registered
        Registrations of both models, made together (see `register`).
    region
        Name of a region defined by landmarks (see `region_masks`), "face" for the whole
        face, or a mask (v, u) of shape (size, size).
    coarsest
        Largest wavelength that is transferred [mm].
    size
        Texels along each side of the maps.

    Returns
    -------
    DataTree
        As `apply_traits` returns it; attribute `edit` names the source, the region and
        the wavelength.

    Raises
    ------
    InputError
        If the consent of one of them does not cover statistics, if the region is
        unknown, if the takes were not registered together, or if the wavelength is
        below four texels.
    """
    for take in (model, source):
        honour_consent(take.attrs, "statistics")
    require(
        np.array_equal(
            registered["landmark"].values, source_registered["landmark"].values
        ),
        "transfer of detail",
        "both takes must be registered together",
        "different sets of landmarks",
        "run skindb register",
    )
    per_texel = float(registered[variables.MM_PER_UV]) / size
    levels = _transferred_levels(coarsest, per_texel, size)
    maps, source_maps = (
        common_maps(take, placed, size=size)
        for take, placed in ((model, registered), (source, source_registered))
    )
    log, _ = log_albedo(maps)
    log_source, is_measured = log_albedo(source_maps)
    mask = _region(region, registered, source_registered, size)
    fraction = np.asarray(mask & is_measured, np.float32)
    # 0 where the source was not measured
    fraction = gaussian_filter(fraction, EDGE / per_texel) * fraction
    changes = [
        _detail_change(log[..., c], log_source[..., c], fraction, levels)
        for c in range(3)
    ]
    change = np.stack(changes, axis=-1)
    fitted = model["fitted"].to_dataset().load()
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    factor = np.exp(at_surfels(change, registered[variables.COMMON_UV].values))
    moved = with_albedo(fitted, colour * factor)
    tree = model.copy()
    tree["fitted"] = DataTree(surviving(moved))
    edited = {
        "detail": str(source.attrs.get("take", "")),
        "region": region if isinstance(region, str) else "mask",
        "coarsest_mm": float(coarsest),
    }
    tree.attrs = take_attrs(model.attrs) | {"edit": edited}
    return tree


def _transferred_levels(coarsest: float, per_texel: float, size: int) -> int:
    """Number of the finest levels of the pyramid with wavelengths up to `coarsest` [mm].

    Raises
    ------
    InputError
        If the wavelength is below four texels.
    """
    levels = math.floor(math.log2(coarsest / per_texel)) - 1 if coarsest > 0 else 0
    levels = min(levels, size.bit_length() - 2)
    require(
        levels >= 1,
        "coarsest",
        f"must be at least four texels of {per_texel:.2g} mm",
        f"{coarsest:g} mm",
        "choose a larger wavelength or more texels",
    )
    return levels


def _detail_change(image: Array, source: Array, fraction: Array, levels: int) -> Array:
    """Change (v, u) of an image that replaces its finest levels by those of another
    image where `fraction` is 1.
    """
    parts = build(source - image, levels)
    weights = level_fractions(fraction, [part.shape for part in parts])
    steps: list[Image] = [w * part for w, part in zip(weights, parts, strict=True)]
    steps[-1] = np.zeros_like(parts[-1])  # the low-pass residual of the face is kept
    return reconstruct(steps)


def _region(
    region: str | Mask, registered: Dataset, source_registered: Dataset, size: int
) -> Mask:
    if not isinstance(region, str):
        mask = np.asarray(region, bool)
        require(
            mask.shape == (size, size),
            "region",
            f"a mask must have ({size}, {size}) texels",
            str(mask.shape),
            "pass a mask of that shape, or another size",
        )
        return mask
    landmarks = common_landmarks({"own": registered, "other": source_registered})
    drawn = map_regions(landmarks, size)
    require(
        region in drawn,
        f"region {region}",
        "must be a region defined by the landmarks",
        "an unknown name",
        f"choose one of {', '.join(drawn)}",
    )
    return drawn[region]

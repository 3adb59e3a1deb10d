"""Principal components of a cohort: how its takes differ most (Weyrich et al. 2005, section 10.2)."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb._types import Array, Mask
from skindb.analysis.each_take import each_take, shared_once
from skindb.errors import Fault, InputError
from skindb.numerics.principal import principal_axes

UNIT = {"units": "1", "long_name": "unit vector"}
LEAST_KNOWN = 0.5  # share of the entries that a take must have: with fewer, the others would lose theirs


def principal_components(values: xr.DataArray, *, most: int = 10, least_known: float = LEAST_KNOWN) -> xr.Dataset:
    """Mean, principal axes and scores of the takes of a cohort.

    Every take is read by tasks of its own; the vectors of all are kept in memory in their own precision (550 MB of 174
    maps of 512 texels).

    Parameters
    ----------
    values
        Of a cohort, with the dimension ``take`` and any others: histograms, maps on the common (u, v), colours.
    most
        Components, at most; never more than takes less one.
    least_known
        Takes of which a smaller share of the entries is known are left out. Of the others, the entries are used that
        all of them have.

    Returns
    -------
    Dataset
        `mean` and `axis` (component, ...) in the units of `values`, NaN where an entry was not used; `score` (take,
        component), so that mean + score axis is the take; `explained_variance` and `explained_variance_ratio`
        (component,); `residual` (take,), the root mean square of what the components leave. Attributes: `skipped`,
        `used_share` of the entries.

    Raises
    ------
    InputError
        With fewer than two takes, or if no entry is known of all of them.

    Examples
    --------
    >>> faces = db.cohort("maps").texel_diffuse_reflectance  # doctest: +SKIP
    >>> principal_components(faces, most=5).axis.sel(component=0).plot.imshow()  # doctest: +SKIP
    """
    others = [str(dim) for dim in values.dims if dim != "take"]
    cohort = values.transpose("take", *others).rename("values").to_dataset()
    takes = [str(take) for take in cohort["take"].values]
    known = each_take(_known, cohort, ["values"])
    share = np.array([one.mean() for one in known])
    kept = np.flatnonzero((share >= least_known) & (share > 0))
    skipped = [f"{takes[i]}: {share[i]:.0%} of its entries are known" for i in range(len(takes)) if i not in kept]
    if len(kept) < 2:
        there, cure = f"{len(kept)} of {len(takes)} with enough values", "fit or register more takes"
        raise InputError(Fault("principal components", "at least two takes are needed", there, cure))
    used: Mask = np.logical_and.reduce([known[i] for i in kept])
    if not used.any():
        there, cure = f"none of {used.size}", "leave out takes that cover other parts, by a larger least_known"
        raise InputError(Fault("principal components", "some entries must be known of every take", there, cure))
    once = shared_once(used)
    found = principal_axes(np.stack(each_take(_vector, cohort.isel(take=kept), ["values"], once)), most)
    ratio = found.variance / (found.total or 1.0)
    shape = tuple(cohort.sizes[dim] for dim in others)
    units = values.attrs.get("units", "1")
    ds = xr.Dataset(
        {
            "mean": (others, _placed(found.mean, used, shape), {"units": units}),
            "axis": (
                ["component", *others],
                _placed(found.axes, used, shape),
                UNIT,
            ),
            "score": (["take", "component"], found.score, {"units": units}),
            "explained_variance": (["component"], found.variance, {"long_name": "variance of the score"}),
            "explained_variance_ratio": (["component"], ratio),
            "residual": (["take"], found.residual, {"units": units, "long_name": "root mean square of what is left"}),
        },
        coords={"component": np.arange(len(found.variance)), "take": cohort["take"].values[kept]},
        attrs={"skipped": skipped, "used_share": float(used.mean())},
    )
    return ds.assign_coords({dim: cohort[dim] for dim in others if dim in cohort.coords})


def _known(take: xr.Dataset) -> Mask:
    return np.asarray(np.isfinite(take["values"].values).ravel())


def _vector(take: xr.Dataset, used: Mask) -> Array:
    return np.asarray(take["values"].values.ravel()[used])


def _placed(values: Array, used: Mask, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Entries (..., used) at their places in (..., *shape); NaN elsewhere."""
    out = np.full((*values.shape[:-1], used.size), np.nan)
    out[..., used] = values
    return out.reshape(*values.shape[:-1], *shape)

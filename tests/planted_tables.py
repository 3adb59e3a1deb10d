"""Cohorts of tables with planted differences between subjects."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.schema import ProbeStatus


def planted_tables(
    subjects,
    *,
    conditions=None,
    albedo=0.0,
    log_tr=0.0,
    seed=0,
    spread=0.03,
    level_error=0.02,
    **coords,
):
    """A cohort of tables; `albedo` and `log_tr` (take,) are added to the values of all subjects."""
    rng = np.random.default_rng([23, seed])
    n = len(subjects)
    who = {name: rng.normal(size=2) for name in dict.fromkeys(subjects)}
    person = np.array([who[name] for name in subjects])
    level = (0.4 + np.broadcast_to(albedo, n) + spread * person[:, 0])[:, None, None]
    level = level + np.array([0.1, 0.0, -0.1]) + 0.002 * rng.normal(size=(n, 2, 3))
    log_tr = (np.broadcast_to(log_tr, n) + 0.1 * person[:, 1])[
        :, None, None
    ] + 0.02 * rng.normal(size=(n, 1, 3))
    status = np.full((n, 1, 3), ProbeStatus.FITTED)
    conditions = ["normal"] * n if conditions is None else conditions
    variables = {
        "region_diffuse_reflectance": (("take", "region", "channel"), level),
        "region_diffuse_reflectance_error": (
            ("take", "region", "channel"),
            np.full((n, 2, 3), 0.002),
        ),
        "region_surface_reflectance": (
            ("take", "region"),
            0.03 + 0.002 * rng.normal(size=(n, 2)),
        ),
        "site_sigma_tr": (("take", "site", "channel"), np.exp(log_tr)),
        "site_status": (("take", "site", "channel"), status),
    }
    labels = {
        "take": [
            f"{s}.{c}.{i}"
            for i, (s, c) in enumerate(zip(subjects, conditions, strict=True))
        ]
    }
    along = {name: ("take", np.array(values)) for name, values in coords.items()}
    along |= {
        "subject": ("take", list(subjects)),
        "condition": ("take", list(conditions)),
    }
    along |= {"fit_even_reflection_error": ("take", np.full(n, level_error))}
    return xr.Dataset(
        variables, {**labels, "region": ["face", "beard"], "site": ["cheek"], **along}
    )

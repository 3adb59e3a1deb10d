"""The least and the most translucent take, and what translucency does to the edge of a
shadow (figures 17 and 18).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.render.figures import write_grid
from skindb.render.rendering import chosen_camera, render
from skindb.render.scene import Camera, Lights
from skindb.schema.consent import require_consent
from skindb.store import Database
from skindb.types import Progress, silent
from skindb.workflow.audit import logged

SIDE_PX = 320  # of a picture
CLOSE_MM = 40.0  # side of a close-up
# from the front to the subject's left: the shadow of the nose is on the cheek
LIGHT_DEGREES = 65.0
LIGHT_MM = 800.0  # from the nose
# of the diffusion length, between the points that receive light in a close-up
SPACING = 1 / 3
LANDMARK = "nose_tip"


@logged("render")
def translucency_grid(
    db: Database,
    out: Path,
    *,
    site: str = "cheek",
    samples: int = 64,
    progress: Progress | None = None,
) -> dict[str, float]:
    """Draw the takes with the shortest and the longest diffusion length at a site, with
    one light and one exposure.

    The columns are the face with light under the skin, the edge of the nose's shadow
    close up, and the same with light that is reflected where it enters.

    Parameters
    ----------
    db
        Database with models whose subjects consent to exports.
    out
        Picture to write (.png, .pdf, .svg).
    site
        Of the probe.
    samples
        Rays per pixel.
    progress
        Called with the stage, the number of finished pictures and the total number of pictures.

    Returns
    -------
    dict
        Take -> mean of 1 / sigma_tr over red, green and blue [mm].

    Raises
    ------
    InputError
        If fewer than two takes have translucency at that site.
    """
    lengths = _diffusion_lengths(db, site)
    if len(lengths) < 2:
        rule = f"two takes must have translucency at {site}"
        cure = "name another site, or fit more takes"
        raise InputError(Fault(db.url, rule, f"{len(lengths)}", cure))
    chosen = [
        min(lengths, key=lengths.__getitem__),
        max(lengths, key=lengths.__getitem__),
    ]
    tell = progress or silent
    rows = {}
    for i, take in enumerate(chosen):
        tell("render", 3 * i, 6)
        model = db.read("model", take)
        far, near = _cameras(model)
        options: dict[str, Any] = {"lights": _light(model), "samples": samples}
        close: dict[str, Any] = {"camera": near, "spacing": SPACING * lengths[take]}
        pictures = [
            render(model, camera=far, subsurface=True, **options),
            render(model, subsurface=True, **close, **options),
            render(model, **close, **options),
        ]
        rows[f"{take}\n{lengths[take]:.2f} mm"] = [
            one["radiance"].values for one in pictures
        ]
    tell("render", 6, 6)
    write_grid(out, rows, ["light under the skin", "close up", "without"])
    return {take: lengths[take] for take in chosen}


def _diffusion_lengths(db: Database, site: str) -> dict[str, float]:
    """Mean diffusion length [mm] at a site of every take whose subject consents to exports."""
    found = {}
    for take in db.takes("model"):
        model = db.read("model", take)
        try:
            require_consent({**model.attrs, "take": take}, "export")
        except InputError:
            continue
        if "translucency" not in model.children:
            continue
        sites = model["translucency"].to_dataset()
        if site in [str(name) for name in sites["site"].values]:
            sigma = sites["site_sigma_tr"].sel(site=site).values.astype(np.float64)
            if (np.isfinite(sigma) & (sigma > 0)).all():
                found[take] = float((1 / sigma).mean())
    return found


def _nose(model: xr.DataTree) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Tip of the nose (3,), or the middle of the surfels."""
    mesh = model["mesh"].to_dataset()
    if "landmark_position" in mesh and LANDMARK in [
        str(name) for name in mesh["landmark"].values
    ]:
        return np.asarray(
            mesh["landmark_position"].sel(landmark=LANDMARK).values, np.float64
        )
    return np.asarray(
        model["fitted"].to_dataset()["surfel_position"].values.mean(axis=0), np.float64
    )


def _light(model: xr.DataTree) -> Lights:
    """A small light to the subject's left."""
    turn = np.radians(LIGHT_DEGREES)
    towards = np.array([np.sin(turn), 0.15, np.cos(turn)])
    towards /= np.linalg.norm(towards)
    power = np.median(model["dome"].to_dataset()["light_intensity"].values, axis=0)[
        None
    ]
    return Lights(
        _nose(model)[None] + LIGHT_MM * towards,
        power,
        np.full(1, 2.0),
        -towards[None],
        np.zeros(1),
    )


def _cameras(model: xr.DataTree) -> tuple[Camera, Camera]:
    """The frontal camera of the dome with a small picture, and one that looks at the
    edge of the nose's shadow.
    """
    whole, _ = chosen_camera(model["dome"].to_dataset().load(), None)
    scale = SIDE_PX / max(whole.width, whole.height)
    # beside the nose, on the side away from the light
    place = _nose(model) + np.array([-14.0, -2.0, -14.0])
    at = whole.R @ place + whole.t
    pixel = (whole.K @ at)[:2] / at[2]
    zoom = SIDE_PX / (CLOSE_MM * whole.K[0, 0] / at[2])
    K = np.diag([zoom, zoom, 1.0]) @ whole.K
    K[:2, 2] += SIDE_PX / 2 - zoom * pixel
    far = whole.scaled(scale)
    middle = far.K.copy()
    middle[:2, 2] += (SIDE_PX - far.width) / 2, (SIDE_PX - far.height) / 2
    return replace(far, K=middle, width=SIDE_PX, height=SIDE_PX), replace(
        whole, K=K, distortion=np.zeros(5), width=SIDE_PX, height=SIDE_PX
    )

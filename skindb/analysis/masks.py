"""Regions of the face in the space all takes share, drawn round the landmarks; regions of the capture have priority.

Weyrich et al. 2005, section 10.2, has a beard and a no-beard region; the finer ones are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Corner = tuple[str, float, float]

# outlines from the middle of the top round the subject's right to the middle of the bottom; the left mirrors it. A
# corner is a landmark and a step to the left and down: of the width between the outer corners of the eyes, and of the
# height from nasion to chin
_MIDDLE: dict[str, tuple[Corner, ...]] = {
    "lips": (
        ("lip_upper", 0, -0.03), ("lip_upper", -0.17, 0), ("mouth_corner_right", -0.02, -0.01),
        ("mouth_corner_right", 0, 0.03), ("lip_lower", -0.2, -0.02), ("lip_lower", 0, 0),
    ),
    "nose": (
        ("nasion", 0, -0.05), ("nasion", -0.11, -0.02), ("nose_tip", -0.23, 0), ("ala_right", -0.06, -0.09),
        ("ala_right", -0.04, 0.02), ("subnasale", -0.13, 0.03), ("subnasale", 0, 0.02),
    ),
    "chin": (
        ("lip_lower", 0, 0), ("mouth_corner_right", -0.1, 0.03), ("mouth_corner_right", -0.07, 0.25),
        ("chin", -0.40, 0.13), ("chin", 0, 0.16),
    ),
    "forehead": (
        ("forehead_centre", 0, -0.19), ("forehead_right", 0, -0.22), ("forehead_right", -0.24, -0.1),
        ("brow_right", -0.39, 0.04), ("brow_right", 0, -0.07), ("nasion", 0, -0.25),
    ),
    "neck": (
        ("chin", 0, 0.17), ("chin", -0.4, 0.16), ("jaw_right", -0.16, 0.26), ("jaw_right", -0.8, 0.26),
        ("jaw_right", -0.8, 1.2), ("chin", 0, 1.2),
    ),
    "beard": (
        ("subnasale", 0, 0.02), ("subnasale", -0.2, 0.04), ("mouth_corner_right", -0.1, -0.07),
        ("jaw_right", -0.05, -0.4), ("jaw_right", -0.2, -0.57), ("jaw_right", -0.46, -0.3), ("jaw_right", -0.24, 0.14),
        ("chin", -0.4, 0.38), ("chin", 0, 0.4),
    ),
}  # fmt: skip
# outlines on the subject's right, all the way round
_SIDE: dict[str, tuple[Corner, ...]] = {
    "eyelid": (
        ("eye_inner_right", 0.07, 0.03), ("eye_inner_right", 0.09, -0.11), ("eye_inner_right", -0.12, -0.14),
        ("eye_outer_right", -0.06, -0.11), ("eye_outer_right", -0.14, -0.01), ("eye_outer_right", -0.07, 0.11),
        ("eye_inner_right", -0.17, 0.17), ("eye_inner_right", -0.04, 0.13),
    ),
    "cheek": (
        ("nose_tip", -0.28, -0.05),
        ("eye_outer_right", 0.05, 0.13), ("eye_outer_right", -0.14, 0.05), ("eye_outer_right", -0.26, 0.03),
        ("eye_outer_right", -0.39, 0.23), ("ala_right", -0.38, 0.03), ("ala_right", -0.1, 0.08),
        ("ala_right", -0.07, -0.09),
    ),
}  # fmt: skip
FINE = ("lips", "eyelid", "nose", "cheek", "chin", "forehead", "neck")  # what an earlier one covers is not the later's
LOWER_LIP = 0.85  # height of the lower lip over that of the upper, below and above the corners of the mouth
SMOOTH_SKIN = ("forehead", "nose", "cheek")


def region_masks(common_uv: Array, landmarks: Mapping[str, Array]) -> dict[str, Mask]:
    """Regions by curves through the landmarks.

    Parameters
    ----------
    common_uv
        (n, 2) texture coordinates in the space of the landmarks.
    landmarks
        Name -> (2,). Regions whose landmarks are not all known are omitted.

    Returns
    -------
    dict
        Name -> (n,) of forehead, nose, cheek, lips, chin, eyelid, neck, which do not overlap; beard, where one may
        grow, without the lips; no_beard, the skin of forehead, nose and cheeks.
    """
    known = {name: np.asarray(p, np.float64) for name, p in landmarks.items() if np.isfinite(p).all()}
    if {"lip_upper", "mouth_corner_right", "mouth_corner_left"} <= known.keys():
        corners = (known["mouth_corner_right"] + known["mouth_corner_left"]) / 2
        known["lip_lower"] = corners + LOWER_LIP * (corners - known["lip_upper"])
    drawn = {name: _drawn(name, common_uv, known) for name in (*FINE, "beard")}
    taken = np.zeros(len(common_uv), np.bool_)
    masks: dict[str, Mask] = {}
    for name in FINE:
        if (own := drawn[name]) is not None:
            masks[name] = own & ~taken
            taken |= own
    if drawn["beard"] is not None and "lips" in masks:
        masks["beard"] = drawn["beard"] & ~masks["lips"]
        if all(name in masks for name in SMOOTH_SKIN):
            masks["no_beard"] = np.any([masks[name] for name in SMOOTH_SKIN], axis=0) & ~masks["beard"]
    return masks


def own_masks(fitted: xr.Dataset) -> dict[str, Mask]:
    """The regions (n,) that came with the capture."""
    if "region_mask" not in fitted:
        return {}
    mask = fitted["region_mask"].values.astype(bool)  # read once: the regions of a surfel lie side by side in the store
    return {str(name): mask[:, i] for i, name in enumerate(fitted["region"].values)}


def drawn_masks(registered: xr.Dataset | None) -> dict[str, Mask]:
    """Regions (n,) that the landmarks of a registered take give; none without a registration."""
    if registered is None:
        return {}
    points = registered["common_landmark"]
    named = {str(name): points.sel(landmark=name).values for name in points["landmark"].values}
    return region_masks(registered["common_uv"].values, named)


def take_masks(model: xr.DataTree, registered: xr.Dataset | None = None) -> dict[str, Mask]:
    """Regions (n,) of a take: its capture's own, then those the landmarks give."""
    return drawn_masks(registered) | own_masks(model["fitted"].to_dataset())


def mask_agreement(mask: Mask, other: Mask, area: Array) -> float:
    """Area both cover over the area either covers; NaN where neither covers any."""
    either = float(area[mask | other].sum())
    return float(area[mask & other].sum()) / either if either else float("nan")


def _drawn(name: str, uv: Array, landmarks: Mapping[str, Array]) -> Mask | None:
    try:
        right = _corners(_MIDDLE.get(name, _SIDE.get(name, ())), landmarks, mirror=False)
        left = _corners(_MIDDLE.get(name, _SIDE.get(name, ())), landmarks, mirror=True)
    except KeyError:
        return None
    if name in _MIDDLE:
        return inside_outline(uv, np.concatenate([right, left[::-1]]))
    return inside_outline(uv, right) | inside_outline(uv, left)


def _corners(outline: tuple[Corner, ...], landmarks: Mapping[str, Array], *, mirror: bool) -> Array:
    """Corners (m, 2) of an outline, on the subject's right or mirrored."""
    across = landmarks["eye_outer_left"] - landmarks["eye_outer_right"]
    down = landmarks["chin"] - landmarks["nasion"]
    if mirror:
        across = -across
        outline = tuple((name.replace("_right", "_left"), right, below) for name, right, below in outline)
    return np.array([landmarks[name] + right * across + below * down for name, right, below in outline])


def inside_outline(points: Array, outline: Array) -> Mask:
    """Whether points (n, 2) lie inside a closed outline (m, 2): a line to the right of them crosses it an odd time."""
    inside = np.zeros(len(points), np.bool_)
    x, y = points[:, 0], points[:, 1]
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside

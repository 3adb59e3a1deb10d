"""Regions of the face in the common (u, v), drawn around the landmarks; regions of the
capture have priority.

Weyrich et al. 2005, section 10.2, defines a beard and a no-beard region; the finer
regions are an addition.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from skindb.schema.label import FACE
from skindb.types import Array, Mask

Corner = tuple[str, float, float]

# Outlines from the middle of the top along the subject's right side to the middle of
# the bottom; the left side is mirrored. A corner is a landmark with an offset to the
# subject's left, as a fraction of the width between the outer corners of the eyes, and
# an offset down, as a fraction of the height from nasion to chin.
_MIDDLE: dict[str, tuple[Corner, ...]] = {
    "lips": (
        ("lip_upper", 0, -0.03),
        ("lip_upper", -0.17, 0),
        ("mouth_corner_right", -0.02, -0.01),
        ("mouth_corner_right", 0, 0.03),
        ("lip_lower", -0.2, -0.02),
        ("lip_lower", 0, 0),
    ),
    "nose": (
        ("nasion", 0, -0.05),
        ("nasion", -0.11, -0.02),
        ("nose_tip", -0.23, 0),
        ("ala_right", -0.06, -0.09),
        ("ala_right", -0.04, 0.02),
        ("subnasale", -0.13, 0.03),
        ("subnasale", 0, 0.02),
    ),
    "chin": (
        ("lip_lower", 0, 0),
        ("mouth_corner_right", -0.1, 0.03),
        ("mouth_corner_right", -0.07, 0.25),
        ("chin", -0.40, 0.13),
        ("chin", 0, 0.16),
    ),
    "forehead": (
        ("forehead_centre", 0, -0.19),
        ("forehead_right", 0, -0.22),
        ("forehead_right", -0.24, -0.1),
        ("brow_right", -0.39, 0.04),
        ("brow_right", 0, -0.07),
        ("nasion", 0, -0.25),
    ),
    "neck": (
        ("chin", 0, 0.17),
        ("chin", -0.4, 0.16),
        ("jaw_right", -0.16, 0.26),
        ("jaw_right", -0.8, 0.26),
        ("jaw_right", -0.8, 1.2),
        ("chin", 0, 1.2),
    ),
    "beard": (
        ("subnasale", 0, 0.02),
        ("subnasale", -0.2, 0.04),
        ("mouth_corner_right", -0.1, -0.07),
        ("jaw_right", -0.05, -0.4),
        ("jaw_right", -0.2, -0.57),
        ("jaw_right", -0.46, -0.3),
        ("jaw_right", -0.24, 0.14),
        ("chin", -0.4, 0.38),
        ("chin", 0, 0.4),
    ),
}
# closed outlines on the subject's right side; the left side is mirrored
_SIDE: dict[str, tuple[Corner, ...]] = {
    "eyelid": (
        ("eye_inner_right", 0.07, 0.03),
        ("eye_inner_right", 0.09, -0.11),
        ("eye_inner_right", -0.12, -0.14),
        ("eye_outer_right", -0.06, -0.11),
        ("eye_outer_right", -0.14, -0.01),
        ("eye_outer_right", -0.07, 0.11),
        ("eye_inner_right", -0.17, 0.17),
        ("eye_inner_right", -0.04, 0.13),
    ),
    "cheek": (
        ("nose_tip", -0.28, -0.05),
        ("eye_outer_right", 0.05, 0.13),
        ("eye_outer_right", -0.14, 0.05),
        ("eye_outer_right", -0.26, 0.03),
        ("eye_outer_right", -0.39, 0.23),
        ("ala_right", -0.38, 0.03),
        ("ala_right", -0.1, 0.08),
        ("ala_right", -0.07, -0.09),
    ),
}
FINE = (
    "lips",
    "eyelid",
    "nose",
    "cheek",
    "chin",
    "forehead",
    "neck",
)  # where two overlap, the earlier one has priority
# ratio of the height of the lower lip below the corners of the mouth to that of the
# upper lip above
LOWER_LIP = 0.85
SMOOTH_SKIN = ("forehead", "nose", "cheek")


def region_masks(common_uv: Array, landmarks: Mapping[str, Array]) -> dict[str, Mask]:
    """Regions bounded by outlines through the landmarks.

    Parameters
    ----------
    common_uv
        (n, 2) common texture coordinates of the points.
    landmarks
        Name -> (2,) common texture coordinates. Regions with an unknown landmark are omitted.

    Returns
    -------
    dict
        Name -> (n,) mask. Forehead, nose, cheek, lips, chin, eyelid and neck do not
        overlap; "beard" is where a beard may grow, without the lips; "no_beard" is the
        skin of forehead, nose and cheeks outside the beard.
    """
    places = {
        name: np.asarray(p, np.float64)
        for name, p in landmarks.items()
        if np.isfinite(p).all()
    }
    if {"lip_upper", "mouth_corner_right", "mouth_corner_left"} <= places.keys():
        corners = (places["mouth_corner_right"] + places["mouth_corner_left"]) / 2
        places["lip_lower"] = corners + LOWER_LIP * (corners - places["lip_upper"])
    drawn = {name: _region_mask(name, common_uv, places) for name in (*FINE, "beard")}
    taken = np.zeros(len(common_uv), np.bool_)
    masks: dict[str, Mask] = {}
    for name in FINE:
        if (mask := drawn[name]) is not None:
            masks[name] = mask & ~taken
            taken |= mask
    if drawn["beard"] is not None and "lips" in masks:
        masks["beard"] = drawn["beard"] & ~masks["lips"]
        if all(name in masks for name in SMOOTH_SKIN):
            masks["no_beard"] = (
                np.any([masks[name] for name in SMOOTH_SKIN], axis=0) & ~masks["beard"]
            )
    return masks


def map_regions(landmarks: Mapping[str, Array], size: int) -> dict[str, Mask]:
    """Masks (v, u) of the regions in the common (u, v), size texels along each side;
    without landmarks only the whole face.
    """
    centre = (np.arange(size) + 0.5) / size
    points = np.stack(np.meshgrid(centre, centre), axis=-1).reshape(-1, 2)
    masks = {FACE: np.ones(len(points), np.bool_)} | region_masks(points, landmarks)
    return {name: mask.reshape(size, size) for name, mask in masks.items()}


def common_landmarks(registered: Mapping[str, xr.Dataset]) -> dict[str, Array]:
    """Mean positions (2,) of the landmarks in the common (u, v), each over the takes
    that have it.
    """
    places: dict[str, list[Array]] = {}
    for take in registered.values():
        names = map(str, take["landmark"].values)
        for name, place in zip(names, take["common_landmark"].values, strict=True):
            if np.isfinite(place).all():
                places.setdefault(name, []).append(place)
    return {name: np.mean(points, axis=0) for name, points in places.items()}


def own_masks(fitted: xr.Dataset) -> dict[str, Mask]:
    """Masks (n,) of the regions that were stored with the capture."""
    if "region_mask" not in fitted:
        return {}
    # read once: the store keeps all regions of a surfel together
    mask = fitted["region_mask"].values.astype(bool)
    return {str(name): mask[:, i] for i, name in enumerate(fitted["region"].values)}


def landmark_masks(registered: xr.Dataset | None) -> dict[str, Mask]:
    """Masks (n,) of the regions defined by the landmarks of a registered take; none
    without a registration.
    """
    if registered is None:
        return {}
    points = registered["common_landmark"]
    named = {
        str(name): points.sel(landmark=name).values
        for name in points["landmark"].values
    }
    return region_masks(registered["common_uv"].values, named)


def take_masks(
    model: xr.DataTree, registered: xr.Dataset | None = None
) -> dict[str, Mask]:
    """Masks (n,) of the regions of a take; those of its capture replace those defined
    by the landmarks.
    """
    return landmark_masks(registered) | own_masks(model["fitted"].to_dataset())


def mask_agreement(mask: Mask, other: Mask, area: Array) -> float:
    """Area of the intersection of two masks divided by the area of their union; NaN if
    both are empty.
    """
    either = float(area[mask | other].sum())
    return float(area[mask & other].sum()) / either if either else float("nan")


def _region_mask(name: str, uv: Array, landmarks: Mapping[str, Array]) -> Mask | None:
    """Mask (n,) of one region on both sides of the face; None if a landmark is missing."""
    try:
        right = _corners(
            _MIDDLE.get(name, _SIDE.get(name, ())), landmarks, mirror=False
        )
        left_corners = _corners(
            _MIDDLE.get(name, _SIDE.get(name, ())), landmarks, mirror=True
        )
    except KeyError:
        return None
    if name in _MIDDLE:
        return inside_outline(uv, np.concatenate([right, left_corners[::-1]]))
    return inside_outline(uv, right) | inside_outline(uv, left_corners)


def _corners(
    outline: tuple[Corner, ...], landmarks: Mapping[str, Array], *, mirror: bool
) -> Array:
    """Corners (m, 2) of an outline on the subject's right side, or mirrored to the left."""
    across = landmarks["eye_outer_left"] - landmarks["eye_outer_right"]
    down = landmarks["chin"] - landmarks["nasion"]
    if mirror:
        across = -across
        outline = tuple(
            (name.replace("_right", "_left"), right, below)
            for name, right, below in outline
        )
    return np.array(
        [
            landmarks[name] + right * across + below * down
            for name, right, below in outline
        ]
    )


def inside_outline(points: Array, outline: Array) -> Mask:
    """Whether points (n, 2) lie inside a closed outline (m, 2), by the even-odd rule."""
    inside = np.zeros(len(points), np.bool_)
    x = points[:, 0]
    y = points[:, 1]
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (
                x < ax + (y - ay) / (by - ay) * (bx - ax)
            )
    return inside

"""Regions of the face in the common (u, v), drawn around the landmarks; regions of the
capture have priority.

Weyrich et al. 2005, section 10.2, defines a beard and a no-beard region; the finer
regions are an addition.
"""

from collections.abc import Mapping
from functools import cache

import numpy as np
from skimage.measure import points_in_poly
from xarray import Dataset, DataTree

from skindb.files import package_json
from skindb.schema import fitted_of, variables
from skindb.schema.label import FACE
from skindb.types import Array, Mask, float64

Corner = tuple[str, float, float]

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
    places = {name: float64(p) for name, p in landmarks.items() if np.isfinite(p).all()}
    if {"lip_upper", "mouth_corner_right", "mouth_corner_left"} <= places.keys():
        corners = (places["mouth_corner_right"] + places["mouth_corner_left"]) / 2
        places["lip_lower"] = corners + LOWER_LIP * (corners - places["lip_upper"])
    drawn = {name: _region_mask(name, common_uv, places) for name in (*FINE, "beard")}
    taken = np.zeros(len(common_uv), bool)
    masks = {}
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
    masks = {FACE: np.ones(len(points), bool)} | region_masks(points, landmarks)
    return {name: mask.reshape(size, size) for name, mask in masks.items()}


def common_landmarks(registered: Mapping[str, Dataset]) -> dict[str, Array]:
    """Mean positions (2,) of the landmarks in the common (u, v), each over the takes
    that have it.
    """
    places: dict[str, list[Array]] = {}
    for take in registered.values():
        for name, place in _landmarks(take).items():
            if np.isfinite(place).all():
                places.setdefault(name, []).append(place)
    return {name: np.mean(points, axis=0) for name, points in places.items()}


def _landmarks(registered: Dataset) -> dict[str, Array]:
    """Positions (2,) of the landmarks of a take in the common (u, v)."""
    points = registered[variables.COMMON_LANDMARK].values
    return dict(zip(map(str, registered["landmark"].values), points, strict=True))


def own_masks(fitted: Dataset) -> dict[str, Mask]:
    """Masks (n,) of the regions that were stored with the capture."""
    if variables.REGION_MASK not in fitted:
        return {}
    # read once: the store keeps all regions of a surfel together
    mask = fitted[variables.REGION_MASK].values.astype(bool)
    return {str(name): mask[:, i] for i, name in enumerate(fitted["region"].values)}


def landmark_masks(registered: Dataset | None) -> dict[str, Mask]:
    """Masks (n,) of the regions defined by the landmarks of a registered take; none
    without a registration.
    """
    if registered is None:
        return {}
    uv = registered[variables.COMMON_UV].values
    return region_masks(uv, _landmarks(registered))


def take_masks(model: DataTree, registered: Dataset | None = None) -> dict[str, Mask]:
    """Masks (n,) of the regions of a take; those of its capture replace those defined
    by the landmarks.
    """
    return landmark_masks(registered) | own_masks(fitted_of(model))


@cache
def _outlines() -> dict[str, dict[str, list[Corner]]]:
    """Outlines "middle" and "side" by the names of the regions.

    Those of the middle run from the middle of the top along the subject's right side to
    the middle of the bottom; those of the side are closed. Both are mirrored to the
    left. A corner is a landmark with an offset to the subject's left, as a fraction of
    the width between the outer corners of the eyes, and an offset down, as a fraction
    of the height from nasion to chin.
    """
    outlines: dict[str, dict[str, list[Corner]]]
    outlines = package_json("skindb.analysis", "regions.json")
    return outlines


def _region_mask(name: str, uv: Array, landmarks: Mapping[str, Array]) -> Mask | None:
    """Mask (n,) of one region on both sides of the face; None if a landmark is missing."""
    middle = _outlines()["middle"].get(name)
    outline = middle or _outlines()["side"][name]
    try:
        sides = [_corners(outline, landmarks, mirror) for mirror in (False, True)]
    except KeyError:
        return None
    if middle:
        right, left = sides
        sides = [np.concatenate([right, left[::-1]])]
    return np.asarray(np.any([points_in_poly(uv, side) for side in sides], axis=0))


def _corners(
    outline: list[Corner], landmarks: Mapping[str, Array], mirror: bool
) -> Array:
    """Corners (m, 2) of an outline on the subject's right side, or mirrored to the left."""
    across = landmarks["eye_outer_left"] - landmarks["eye_outer_right"]
    down = landmarks["chin"] - landmarks["nasion"]
    corners = []
    for name, sideways, below in outline:
        place = landmarks[name.replace("_right", "_left") if mirror else name]
        corners.append(
            place + (-sideways if mirror else sideways) * across + below * down
        )
    return np.array(corners)

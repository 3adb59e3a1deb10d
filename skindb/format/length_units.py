"""Units of length: whether scan, landmarks, cameras and lights can be in mm and in one
frame, and the likely units of parts that cannot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.scan_checks import (
    FACE_HEIGHT,
    FACE_HEIGHTS,
    HEAD_DIAGONAL,
    LANDMARK_REACH,
    SCAN_DIAGONAL,
    UNITS,
    face_height,
    likely_unit,
    rescaling,
)
from skindb.geometry.camera import camera_centre
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import closest_on_mesh, face_crosses, winding_number
from skindb.geometry.scan import Scan

Array = NDArray[np.float64]

SCAN = "scan"
LANDMARKS = "landmarks"
CAMERAS = "cameras"
LIGHTS = "lights"
SIZES = {
    SCAN: "diagonal of the scan",
    LANDMARKS: "face from eyes to mouth",
    CAMERAS: "cameras at",
    LIGHTS: "lights at",
}
LENGTHS = {
    SCAN: "the vertices of the scan",
    LANDMARKS: "the landmarks",
    CAMERAS: "t of the cameras",
    LIGHTS: "position of the lights",
}
MM = {"millimetres": 1.0, **UNITS}  # mm of each
# mm from the origin: 100 m; domes have a radius of 0.5 to 5 m
MAX_DEVICE_DISTANCE_MM = 100_000.0
# distance of the lights over the diagonal of a head; below it they are inside
MIN_LIGHT_RATIO = 0.6
# logarithm of a factor, of lengths that are as far from the usual ones as one more
# part, or one more unit, is unlikely
PART_COST = UNIT_COST = 0.7
MAX_VERTICES = 5_000  # of a scan, for its span in the pictures
# of a point inside; outside the convex hull of a surface it is at most 0.5
MIN_WINDING_NUMBER = 0.5
# of the longest side of a picture. Heads in a dome span 0.7 to 1; ten times too far
# away they span at most 0.1
LEAST_SPAN = 0.1
USUAL_SPAN = 0.8
# for a small scan: a patch of 20 mm in a picture of a person of 1.7 m spans 0.01
PATCH_SPAN = 0.005
# mm, of a child's face; a scan of this size is not a patch of skin
FACE_DIAGONAL = 200.0
LARGEST_HEAD = 700.0  # mm, with neck and shoulders
# |sum of normals| over area: at most 0.47 for faces and heads, 0.75 to 1 for patches of
# cheek, forehead and jaw
MAX_MEAN_NORMAL = 0.6
# distance of the devices over the diagonal of a head; domes of 0.8 m have 2.1 to 2.5
DOME_RADIUS_RATIO = 2.0


@dataclass(frozen=True)
class Lengths:
    """Parts of a capture, as far as they are known; `middles` are the centres of named
    regions of the scan.
    """

    scan: Scan
    landmarks: Mapping[str, Array]
    middles: Mapping[str, Array]
    dome: DomeRecord | None

    @property
    def diagonal(self) -> float:
        """Diagonal of the scan."""
        return float(np.linalg.norm(np.ptp(self.scan.vertices, axis=0)))

    @property
    def sizes(self) -> dict[str, float]:
        """A length of each part: diagonal, height of the face, median distances from
        the centre of the scan.
        """
        sizes = {SCAN: self.diagonal}
        if (height := face_height(self.landmarks)) is not None:
            sizes[LANDMARKS] = height
        if self.dome is not None and self.dome.cameras:
            sizes[CAMERAS] = self._distance([*device_positions(self.dome).values()])
        if self.dome is not None and self.dome.lights:
            sizes[LIGHTS] = self._distance(
                [light.position for light in self.dome.lights]
            )
        return sizes

    def _distance(self, places: list[Array], factor: float = 1.0) -> float:
        middle = self.scan.vertices.mean(axis=0)
        return float(
            np.median(np.linalg.norm(factor * np.array(places) - middle, axis=1))
        )


def likely_units(lengths: Lengths) -> dict[str, str]:
    """The unit of each part that is not in mm; empty if all of them may be, or if no
    units make a capture of a head.

    Of all combinations, the one is chosen in which lengths are closest to those of
    heads in domes, and in which the fewest parts are in the fewest other units.
    """
    parts = [*lengths.sizes]
    near = (
        {ratio: _landmarks_near(lengths, ratio) for ratio in _ratios()}
        if LANDMARKS in parts
        else {}
    )
    views = {ratio: _device_cost(lengths, ratio) for ratio in _ratios()}
    best = dict[str, str]()
    least = inf
    for names in product(MM, repeat=len(parts)):
        units = dict(zip(parts, names, strict=True))
        other = {part: unit for part, unit in units.items() if MM[unit] != 1}
        cost = PART_COST * len(other) + UNIT_COST * max(len({*names}) - 1, 0)
        if cost < least:
            cost += _cost(
                lengths, {part: MM[unit] for part, unit in units.items()}, near, views
            )
        if cost < least:
            best = other
            least = cost
    return best


def _ratios() -> set[float]:
    """Ratios of the units of two parts."""
    return {a / b for a, b in product(MM.values(), repeat=2)}


def _cost(
    lengths: Lengths,
    factor: Mapping[str, float],
    near: Mapping[float, float],
    views: Mapping[float, tuple[float, float]],
) -> float:
    """Sum of the logarithms by which lengths differ from the usual ones; infinite for
    lengths that are impossible.
    """
    sizes = {part: factor[part] * size for part, size in lengths.sizes.items()}
    height = sizes.get(LANDMARKS, (face_height(lengths.middles) or 0.0) * factor[SCAN])
    if not SCAN_DIAGONAL[0] <= sizes[SCAN] <= SCAN_DIAGONAL[1] or (
        height and not _within(height, FACE_HEIGHTS)
    ):
        return inf
    cost = (
        abs(log(height / FACE_HEIGHT))
        if height
        else abs(log(sizes[SCAN] / HEAD_DIAGONAL))
    )
    if LANDMARKS in factor and min(near.values()) < LANDMARK_REACH / factor[SCAN]:
        cost += (
            0.0
            if near[factor[LANDMARKS] / factor[SCAN]] <= LANDMARK_REACH / factor[SCAN]
            else inf
        )
    if CAMERAS in factor:
        cost += views[factor[CAMERAS] / factor[SCAN]][0]
    if LIGHTS in factor:
        cost += views[factor[LIGHTS] / factor[SCAN]][1]
    return cost


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _landmarks_near(lengths: Lengths, ratio: float) -> float:
    """Median distance of the landmarks from the scan, in its unit, if they are this
    many times larger.
    """
    points = ratio * np.array([*lengths.landmarks.values()])
    return float(
        np.median(closest_on_mesh(lengths.scan.vertices, lengths.scan.faces, points)[2])
    )


def _device_cost(lengths: Lengths, ratio: float) -> tuple[float, float]:
    """Costs of cameras and lights that are this many times farther away, in the unit of
    the scan.
    """
    if lengths.dome is None:
        return 0.0, 0.0
    vertices = lengths.scan.vertices[:: -(-len(lengths.scan.vertices) // MAX_VERTICES)]
    spans = [
        picture_span(camera, vertices, factor=ratio) for camera in lengths.dome.cameras
    ]
    known = [span for span in spans if span is not None and np.isfinite(span)]
    camera = (
        abs(log(float(np.median(known)) / USUAL_SPAN))
        if 2 * len(known) >= len(spans)
        else inf
    )
    places = [light.position for light in lengths.dome.lights]
    far = lengths._distance(places, ratio) / lengths.diagonal
    return camera, abs(log(far / DOME_RADIUS_RATIO)) if far >= MIN_LIGHT_RATIO else inf


def unit_text(units: Mapping[str, str]) -> str:
    """The correction for parts in other units, for a message."""
    said = list[str]()
    for unit in dict.fromkeys(units.values()):
        lengths = _listed([LENGTHS[part] for part, own in units.items() if own == unit])
        how = (
            f"multiply {lengths} by {UNITS[unit]:g}"
            if UNITS[unit] > 1
            else f"divide {lengths} by {1 / UNITS[unit]:g}"
        )
        said.append(f"these look like {unit}: {how}")
    beside = (
        ""
        if {CAMERAS, LIGHTS}.isdisjoint(units)
        else "; check disc_radius and the white target too"
    )
    return f"{'; '.join(said)}{beside}"


def _listed(words: list[str]) -> str:
    return (
        " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]
    )


def device_faults(where: str, dome: DomeRecord, surface: CleanMesh) -> list[Fault]:
    """Faults of cameras and lights that are inside the head, or too far away."""
    faults = []
    for key, places in (
        ("cameras", device_positions(dome)),
        ("lights", {light.id: light.position for light in dome.lights}),
    ):
        far = [
            name
            for name, place in places.items()
            if np.linalg.norm(place) > MAX_DEVICE_DISTANCE_MM
        ]
        if far:
            rule = (
                f"{key} must be within {MAX_DEVICE_DISTANCE_MM / 1000:g} m of the "
                "origin of the scan's frame"
            )
            found = (
                f"{len(far)} of {len(places)} farther: "
                f"{', '.join(far[:3])}{', ..' * (len(far) > 3)}"
            )
            faults.append(Fault(f"{where}[{key}]", rule, found, "give positions in mm"))
        inside = [name for name, place in places.items() if _inside(surface, place)]
        if inside:
            found = (
                f"{len(inside)} of {len(places)} inside it: "
                f"{', '.join(inside[:3])}{', ..' * (len(inside) > 3)}"
            )
            cure = "calibrate in mm and in the frame of the scan; the centre of a camera is -R^T t"
            faults.append(
                Fault(f"{where}[{key}]", f"{key} must be outside the head", found, cure)
            )
    return faults


def unit_fault(
    where: str, dome: DomeRecord, mesh: str, surface: CleanMesh, *, sized: bool
) -> Fault | None:
    """Fault of a dome and a scan that cannot both be in mm, or cannot be in the same frame.

    Only impossible captures are faults: a dome within the bounding box of the scan; a
    scan that no camera shows; a scan that is large enough for a face but spans less
    than a tenth of every picture. A small scan that spans as little is a fault if it is
    probably a head in centimetres or inches: it curves around the origin of its frame,
    which a patch of skin does not. If scan and dome are both too small by the same
    factor, only the landmarks reveal it.

    Parameters
    ----------
    where, mesh
        Files of the dome and of the scan, for the message.
    dome, surface
        As read.
    sized
        Whether landmarks or regions have shown that the face is in mm.
    """
    low = surface.vertices.min(axis=0)
    high = surface.vertices.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    places = np.array(
        [*device_positions(dome).values(), *(light.position for light in dome.lights)]
    )
    if ((places > low) & (places < high)).all():
        # the origin is near the centre of the dome
        distance = float(np.median(np.linalg.norm(places, axis=1)))
        cure = (
            f"{rescaling(likely_unit(distance, DOME_RADIUS_RATIO * diagonal))}, or "
            "calibrate in the frame of the scan"
        )
        rule = "lengths must be in mm, and a dome must surround the scan"
        return Fault(where, rule, "all of it within the bounding box of the scan", cure)
    spans = [
        span
        for camera in dome.cameras
        if (span := picture_span(camera, surface.vertices)) is not None
    ]
    if not spans:
        cure = (
            "calibrate in mm and in the frame of the scan: x_cam = R x + t, z forwards"
        )
        return Fault(
            where,
            "the picture of a camera must show the scan",
            f"none of {len(dome.cameras)} does",
            cure,
        )
    span = max(spans)
    if not sized and span < LEAST_SPAN and _shrunken_head(surface, diagonal):
        rule = (
            "lengths must be in mm, and a head must span at least a tenth of a picture"
        )
        found = f"{diagonal:.0f} mm across, {span:.1%} of a picture's side"
        return Fault(mesh, rule, found, rescaling(likely_unit(diagonal, HEAD_DIAGONAL)))
    if span < (LEAST_SPAN if diagonal > FACE_DIAGONAL else PATCH_SPAN):
        rule = "lengths must be in mm, and the scan must be visible in the pictures"
        found = f"{diagonal:,.0f} mm across, it spans {span:.2%} of a picture's side"
        return Fault(where, rule, found, rescaling(likely_unit(USUAL_SPAN / span, 1.0)))
    return None


def device_positions(dome: DomeRecord) -> dict[str, Array]:
    """Centres of the cameras."""
    return {
        camera.id: np.asarray(camera_centre(camera.R, camera.t), np.float64)
        for camera in dome.cameras
    }


def _inside(surface: CleanMesh, place: Array) -> bool:
    within = (place > surface.vertices.min(axis=0)) & (
        place < surface.vertices.max(axis=0)
    )
    return bool(
        within.all()
        and winding_number(surface.vertices, surface.faces, place)[0]
        > MIN_WINDING_NUMBER
    )


def picture_span(
    camera: CameraRecord, vertices: Array, *, factor: float = 1.0
) -> float | None:
    """Fraction of the picture's side that the scan spans; None if it is outside the
    picture or behind the camera.

    The camera is taken to be `factor` times as far away.

    Distortion is ignored, and the picture is extended by half its size: only scans
    clearly outside count as invisible.
    """
    local = vertices @ camera.R.T + factor * camera.t
    if (local[:, 2] <= 0).all():
        return None
    if (local[:, 2] <= 0).any():
        return np.inf  # the camera is inside the scan
    pixels = local @ camera.K.T
    places = pixels[:, :2] / pixels[:, 2:] / [camera.width, camera.height]
    low = places.min(axis=0)
    high = places.max(axis=0)
    return (
        float((high - low).max()) if (low < 1.5).all() and (high > -0.5).all() else None
    )


def _shrunken_head(surface: CleanMesh, diagonal: float) -> bool:
    """Whether a surface has the size of a head in inches or centimetres, and curves
    around the origin of its frame.
    """
    unit = UNITS[likely_unit(diagonal, HEAD_DIAGONAL)]
    cross = face_crosses(surface.vertices, surface.faces)
    facing = np.linalg.norm(cross.sum(axis=0)) / np.linalg.norm(cross, axis=1).sum()
    away = np.linalg.norm(surface.vertices.mean(axis=0))
    return bool(
        unit > 1
        and FACE_DIAGONAL < unit * diagonal < LARGEST_HEAD
        and facing < MAX_MEAN_NORMAL
        and away < diagonal
    )

"""Domes that cannot be those of the scan: in another unit than it, devices inside the head, nothing in the pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.geometry.camera import camera_centre
from skindb.geometry.clean import CleanMesh
from skindb.geometry.nearest import winding_number
from skindb.geometry.surfels import face_crosses
from skindb.ingest.devices import CameraRecord, DomeRecord
from skindb.ingest.plausible import HEAD_DIAGONAL, UNITS, likely_unit, rescaling
from skindb.ingest.plausible_devices import MAX_DEVICE_DISTANCE_MM

Array = NDArray[np.float64]
MIN_WINDING_NUMBER = 0.5  # winding number; outside the convex hull of any surface it is at most a half
# of the longest side of a picture. Heads in their dome span 0.7 to 1; ten times too far away they span 0.1 at most
LEAST_SPAN, USUAL_SPAN = 0.1, 0.8
PATCH_SPAN = 0.005  # of a small scan: 20 mm beside a person of 1.7 m span 0.01
FACE_DIAGONAL = 200.0  # mm; a scan as large is no patch: the face alone of a child is
LARGEST_HEAD = 700.0  # mm, with neck and shoulders
# |sum of normals| by area: faces and heads 0.47 and less, skin cut from cheek, forehead and jaw 0.75 to 1
MAX_MEAN_NORMAL = 0.6
DOME_RADIUS_RATIO = 2.0  # distance of lights and cameras per diagonal of a head; domes of 0.8 m have 2.1 to 2.5


def device_faults(where: str, dome: DomeRecord, surface: CleanMesh) -> list[Fault]:
    """Cameras and lights inside the head, or farther away than any room reaches."""
    faults = []
    for key, places in (("cameras", _eyes(dome)), ("lights", {light.id: light.position for light in dome.lights})):
        far = [name for name, place in places.items() if np.linalg.norm(place) > MAX_DEVICE_DISTANCE_MM]
        if far:
            rule = f"{key} stand within {MAX_DEVICE_DISTANCE_MM / 1000:g} m of the origin of the scan's frame"
            found = f"{len(far)} of {len(places)} farther: {', '.join(far[:3])}{', ..' * (len(far) > 3)}"
            faults.append(Fault(f"{where}[{key}]", rule, found, "give positions in mm"))
        inside = [name for name, place in places.items() if _inside(surface, place)]
        if inside:
            found = f"{len(inside)} of {len(places)} inside it: {', '.join(inside[:3])}{', ..' * (len(inside) > 3)}"
            cure = "calibrate in mm and in the frame of the scan; the centre of a camera is -R^T t"
            faults.append(Fault(f"{where}[{key}]", f"{key} stand outside the head", found, cure))
    return faults


def unit_fault(where: str, dome: DomeRecord, mesh: str, surface: CleanMesh, *, sized: bool) -> Fault | None:
    """A dome and a scan that cannot both be in mm, or cannot be in one frame.

    Only what no capture can be: a dome that stands within the box around the scan; a scan that no camera shows; one
    that is large enough for a face and spans less than a tenth of every picture. Of a small scan that spans as little
    it is asked whether it is a head in centimetres or inches, and no skin cut from one: it curves round, and lies where
    its frame begins. Where both the scan and the dome are small alike nothing tells but the names on the face.

    Parameters
    ----------
    where, mesh
        Of the dome and of the scan, for the message.
    dome, surface
        As read.
    sized
        The size of the face is known to be one in mm, by its landmarks or regions.
    """
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    places = np.array([*_eyes(dome).values(), *(light.position for light in dome.lights)])
    if ((places > low) & (places < high)).all():
        distance = float(np.median(np.linalg.norm(places, axis=1)))  # domes are calibrated about their middle
        cure = (
            f"{rescaling(likely_unit(distance, DOME_RADIUS_RATIO * diagonal))}, or calibrate in the frame of the scan"
        )
        return Fault(where, "lengths are in mm, and a dome stands around the scan", "all of it in the scan's box", cure)
    spans = [span for camera in dome.cameras if (span := _span(camera, surface.vertices)) is not None]
    if not spans:
        cure = "calibrate in mm and in the frame of the scan: x_cam = R x + t, z forwards"
        return Fault(where, "a camera's picture shows the scan", f"none of {len(dome.cameras)} does", cure)
    span = max(spans)
    if not sized and span < LEAST_SPAN and _shrunken_head(surface, diagonal):
        rule = "lengths are in mm, and a head spans a tenth of a picture or more"
        found = f"{diagonal:.0f} mm across, {span:.1%} of a picture's side"
        return Fault(mesh, rule, found, rescaling(likely_unit(diagonal, HEAD_DIAGONAL)))
    if span < (LEAST_SPAN if diagonal > FACE_DIAGONAL else PATCH_SPAN):
        rule = "lengths are in mm, and the scan is to be seen in the pictures"
        found = f"{diagonal:,.0f} mm across, it spans {span:.2%} of a picture's side"
        return Fault(where, rule, found, rescaling(likely_unit(USUAL_SPAN / span, 1.0)))
    return None


def _eyes(dome: DomeRecord) -> dict[str, Array]:
    return {camera.id: np.asarray(camera_centre(camera.R, camera.t), np.float64) for camera in dome.cameras}


def _inside(surface: CleanMesh, place: Array) -> bool:
    within = (place > surface.vertices.min(axis=0)) & (place < surface.vertices.max(axis=0))
    return bool(within.all() and winding_number(surface.vertices, surface.faces, place)[0] > MIN_WINDING_NUMBER)


def _span(camera: CameraRecord, vertices: Array) -> float | None:
    """How much of its picture's side the scan spans; None if it lies beside the picture or behind the camera.

    Without distortion, and by half a picture beyond the rim: only what is clearly elsewhere is not seen.
    """
    local = vertices @ camera.R.T + camera.t
    if (local[:, 2] <= 0).all():
        return None
    if (local[:, 2] <= 0).any():
        return np.inf  # all round the camera
    pixels = local @ camera.K.T
    places = pixels[:, :2] / pixels[:, 2:] / [camera.width, camera.height]
    low, high = places.min(axis=0), places.max(axis=0)
    return float((high - low).max()) if (low < 1.5).all() and (high > -0.5).all() else None


def _shrunken_head(surface: CleanMesh, diagonal: float) -> bool:
    """A surface as large as heads are in inches or centimetres, that curves round and lies where its frame begins."""
    unit = UNITS[likely_unit(diagonal, HEAD_DIAGONAL)]
    cross = face_crosses(surface.vertices, surface.faces)
    facing = np.linalg.norm(cross.sum(axis=0)) / np.linalg.norm(cross, axis=1).sum()
    away = np.linalg.norm(surface.vertices.mean(axis=0))
    return bool(
        unit > 1 and FACE_DIAGONAL < unit * diagonal < LARGEST_HEAD and facing < MAX_MEAN_NORMAL and away < diagonal
    )

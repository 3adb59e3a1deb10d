"""Plant errors in the calibration of captures, and print the result of the check
against their photographs.

    python -m benchmarks calibration CAPTURE...

The first row of each capture is the unchanged capture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skindb.calibration._merge_kernels import SATURATED
from skindb.calibration.irradiance import light_intensities
from skindb.calibration.radiance import frame_mergers, read_view
from skindb.format.dome import DomeRecord
from skindb.format.folder import read_capture
from skindb.geometry.rays import RayScene
from skindb.ingest.consistency import Calibration, CalibrationCheck
from skindb.ingest.faults import calibration_faults, calibration_notes
from skindb.ingest.surfels import (
    SurfelSet,
    build_surfels,
    camera_visibility,
    light_visibility,
)

Pictures = Callable[[int, int], Any]
Case = tuple[str, DomeRecord, SurfelSet, Pictures]
SPACING_MM = 3.0


def main(captures: Sequence[Path]) -> None:
    """Print one row for each planted error."""
    print(
        "| capture | planted | largest offset [mm] | agreement of cameras, lights "
        "| result |\n|---|---|---|---|---|"
    )
    for folder in captures:
        for row in _rows(folder):
            print("| " + " | ".join(row) + " |", flush=True)


def _rows(folder: Path) -> Iterator[list[str]]:
    capture = read_capture(folder)
    dome = capture.dome
    assert dome is not None
    mergers = frame_mergers(dome, [])

    def picture(j: int, c: int) -> Any:
        camera = dome.cameras[c]
        radiance, flag = mergers[camera.id].merge(
            read_view(dome, dome.lights[j].id, camera)
        )
        return np.where((flag == SATURATED)[..., None], np.float32(np.nan), radiance)

    surfels = build_surfels(capture, spacing_mm=SPACING_MM)
    with ThreadPoolExecutor() as pool:
        for name, planted, moved, pictures in _cases(dome, surfels, picture):
            intensity = light_intensities(planted, mergers, pool)
            scene = RayScene(moved.position, moved.faces)
            lit = light_visibility(moved, planted.lights, scene, pool)
            _, clear, pixels = camera_visibility(moved, planted.cameras, scene, pool)
            check = CalibrationCheck(planted, moved, lit, clear, pixels, intensity)
            result = check.evaluate(
                {pair: check.reduce(pair[1], pictures(*pair)) for pair in check.pairs}
            )
            agreements = (result.camera_agreement, result.light_agreement)
            yield [
                folder.name,
                name,
                f"{np.nanmax(result.camera_offset):.1f}",
                ", ".join(f"{np.nanmin(values):.2f}" for values in agreements),
                _message(planted, result),
            ]


def _message(dome: DomeRecord, result: Calibration) -> str:
    """What ingest would say about the calibration."""
    if faults := calibration_faults(dome, result):
        return f"refused: {faults[0].found}"
    if notes := calibration_notes(dome, result):
        return f"warned: {notes[0]}"
    return "nothing"


def _cases(dome: DomeRecord, surfels: SurfelSet, picture: Pictures) -> Iterator[Case]:
    """The unchanged capture, then one error at a time, of cameras 1 and 2, the scan and
    the lights.
    """
    yield "-", dome, surfels, picture
    for name, planted in _planted_cameras(dome):
        yield name, planted, surfels, picture
    for name, changed in _planted_pictures(picture):
        yield name, dome, surfels, changed
    for name, moved in _planted_scans(surfels):
        yield name, dome, moved, picture
    for name, planted in _planted_lights(dome):
        yield name, planted, surfels, picture

    def exchanged(j: int, c: int) -> Any:
        return picture({3: 9, 9: 3}.get(j, j), c)

    yield "frames of two lights exchanged", dome, surfels, exchanged


def _planted_cameras(dome: DomeRecord) -> Iterator[tuple[str, DomeRecord]]:
    camera_1, camera_2 = dome.cameras[1:3]
    off_centre = camera_2.K + np.eye(3, k=2) * camera_2.width / 13
    for name, changed in (
        ("R transposed", replace(camera_2, R=camera_2.R.T)),
        ("focal length doubled", replace(camera_2, K=_scaled(camera_2.K, 2))),
        ("focal length 5 % too long", replace(camera_2, K=_scaled(camera_2.K, 1.05))),
        ("centre off by a 13th of the width", replace(camera_2, K=off_centre)),
        ("translation 10 % off", replace(camera_2, t=camera_2.t * 1.1)),
    ):
        yield name, _with_cameras(dome, {2: changed})
    exchanged = {
        1: replace(camera_1, R=camera_2.R, t=camera_2.t),
        2: replace(camera_2, R=camera_1.R, t=camera_1.t),
    }
    yield "poses exchanged", _with_cameras(dome, exchanged)


def _planted_pictures(picture: Pictures) -> Iterator[tuple[str, Pictures]]:
    def of_camera_2(change: Callable[[Any], Any]) -> Pictures:
        return lambda j, c: change(picture(j, c)) if c == 2 else picture(j, c)

    def shift(image: Any) -> Any:
        return np.roll(image, image.shape[1] // 20, axis=1)

    yield (
        "frames of two cameras exchanged",
        lambda j, c: picture(j, {1: 2, 2: 1}.get(c, c)),
    )
    yield "pictures upside down", of_camera_2(lambda image: image[::-1, ::-1])
    yield "pictures mirrored", of_camera_2(lambda image: image[:, ::-1])
    yield "pictures shifted by 5 %", of_camera_2(shift)
    yield "blue, green, red", lambda j, c: picture(j, c)[..., ::-1]


def _planted_scans(surfels: SurfelSet) -> Iterator[tuple[str, SurfelSet]]:
    turn = Rotation.from_euler("y", 5, degrees=True).as_matrix()
    for name, rotation, move in (
        ("scan turned by 5 degrees", turn, [0, 0, 0]),
        ("scan moved up by 3 mm", np.eye(3), [0, 3, 0]),
        ("scan moved aside by 3 mm", np.eye(3), [3, 0, 0]),
        ("scan moved up by 30 mm", np.eye(3), [0, 30, 0]),
        ("scan mirrored", np.diag([-1, 1, 1]), [0, 0, 0]),
    ):
        faces = surfels.faces
        if np.linalg.det(rotation) < 0:
            faces = faces[:, ::-1].copy()
        yield (
            name,
            replace(
                surfels,
                position=surfels.position @ rotation.T + move,
                normal=surfels.normal @ rotation.T,
                faces=faces,
            ),
        )


def _planted_lights(dome: DomeRecord) -> Iterator[tuple[str, DomeRecord]]:
    places = np.array([light.position for light in dome.lights])
    distance = np.linalg.norm(places - places[3], axis=1)
    near = int(np.argsort(distance)[1])
    for name, moved in (
        ("two lights exchanged", {3: places[9], 9: places[3]}),
        ("neighbouring lights exchanged", {3: places[near], near: places[3]}),
        ("a light mirrored", {3: places[3] * [-1, 1, 1]}),
    ):
        lights = tuple(
            replace(light, position=moved.get(j, light.position))
            for j, light in enumerate(dome.lights)
        )
        yield name, replace(dome, lights=lights)


def _scaled(K: Any, factor: float) -> Any:
    return K * np.array([[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])


def _with_cameras(dome: DomeRecord, changed: dict[int, Any]) -> DomeRecord:
    return replace(
        dome,
        cameras=tuple(changed.get(c, camera) for c, camera in enumerate(dome.cameras)),
    )

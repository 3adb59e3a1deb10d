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
from skindb.ingest.consistency import CalibrationCheck
from skindb.ingest.consistency_checks import calibration_faults, calibration_notes
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

    with ThreadPoolExecutor() as pool:
        for name, planted, surfels, pictures in _cases(
            dome, build_surfels(capture, spacing_mm=SPACING_MM), picture
        ):
            intensity = light_intensities(planted, mergers, pool)
            scene = RayScene(surfels.position, surfels.faces)
            lit = light_visibility(surfels, planted.lights, scene, pool)
            _, clear, pixels = camera_visibility(surfels, planted.cameras, scene, pool)
            check = CalibrationCheck(planted, surfels, lit, clear, pixels, intensity)
            found = check.evaluate(
                {pair: check.reduce(pair[1], pictures(*pair)) for pair in check.pairs}
            )
            faults = calibration_faults(planted, found)
            notes = calibration_notes(planted, found)
            said = (
                f"refused: {faults[0].found}"
                if faults
                else f"warned: {notes[0]}"
                if notes
                else "nothing"
            )
            agreement = (
                f"{np.nanmin(found.camera_agreement):.2f}, "
                f"{np.nanmin(found.light_agreement):.2f}"
            )
            yield [
                folder.name,
                name,
                f"{np.nanmax(found.camera_offset):.1f}",
                agreement,
                said,
            ]


def _cases(dome: DomeRecord, surfels: SurfelSet, picture: Pictures) -> Iterator[Case]:
    """The unchanged capture, then one error at a time, of cameras 1 and 2, the scan and
    the lights.
    """
    yield "-", dome, surfels, picture
    first, second = dome.cameras[1:3]
    for name, changed in (
        ("R transposed", replace(second, R=second.R.T)),
        ("focal length doubled", replace(second, K=_scaled(second.K, 2))),
        ("focal length 5 % too long", replace(second, K=_scaled(second.K, 1.05))),
        (
            "centre off by a 13th of the width",
            replace(second, K=second.K + np.eye(3, k=2) * second.width / 13),
        ),
        ("translation 10 % off", replace(second, t=second.t * 1.1)),
    ):
        yield name, _with_cameras(dome, {2: changed}), surfels, picture
    exchanged = {
        1: replace(first, R=second.R, t=second.t),
        2: replace(second, R=first.R, t=first.t),
    }
    yield "poses exchanged", _with_cameras(dome, exchanged), surfels, picture
    yield (
        "frames of two cameras exchanged",
        dome,
        surfels,
        lambda j, c: picture(j, {1: 2, 2: 1}.get(c, c)),
    )
    for name, turned in (
        ("pictures upside down", lambda image: image[::-1, ::-1]),
        ("pictures mirrored", lambda image: image[:, ::-1]),
        (
            "pictures shifted by 5 %",
            lambda image: np.roll(image, image.shape[1] // 20, axis=1),
        ),
    ):
        yield (
            name,
            dome,
            surfels,
            lambda j, c, turned=turned: (
                turned(picture(j, c)) if c == 2 else picture(j, c)
            ),
        )
    yield "blue, green, red", dome, surfels, lambda j, c: picture(j, c)[..., ::-1]
    turn = Rotation.from_euler("y", 5, degrees=True).as_matrix()
    for name, rotation, move in (
        ("scan turned by 5 degrees", turn, [0, 0, 0]),
        ("scan moved up by 3 mm", np.eye(3), [0, 3, 0]),
        ("scan moved aside by 3 mm", np.eye(3), [3, 0, 0]),
        ("scan moved up by 30 mm", np.eye(3), [0, 30, 0]),
        ("scan mirrored", np.diag([-1, 1, 1]), [0, 0, 0]),
    ):
        faces = (
            surfels.faces
            if np.linalg.det(rotation) > 0
            else surfels.faces[:, ::-1].copy()
        )
        position = surfels.position @ rotation.T + move
        normal = surfels.normal @ rotation.T
        yield (
            name,
            dome,
            replace(surfels, position=position, normal=normal, faces=faces),
            picture,
        )
    places = np.array([light.position for light in dome.lights])
    far = np.linalg.norm(places - places[3], axis=1)
    near = int(np.argsort(far)[1])
    for name, moved in (
        ("two lights exchanged", {3: places[9], 9: places[3]}),
        ("neighbouring lights exchanged", {3: places[near], near: places[3]}),
        ("a light mirrored", {3: places[3] * [-1, 1, 1]}),
    ):
        lights = tuple(
            replace(x, position=moved.get(j, x.position))
            for j, x in enumerate(dome.lights)
        )
        yield name, replace(dome, lights=lights), surfels, picture
    yield (
        "frames of two lights exchanged",
        dome,
        surfels,
        lambda j, c: picture({3: 9, 9: 3}.get(j, j), c),
    )


def _scaled(K: Any, factor: float) -> Any:
    return K * np.array([[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])


def _with_cameras(dome: DomeRecord, changed: dict[int, Any]) -> DomeRecord:
    return replace(
        dome,
        cameras=tuple(changed.get(c, camera) for c, camera in enumerate(dome.cameras)),
    )

"""A virtual laboratory around a small made-up subject, whose devices run ten times as fast."""

from __future__ import annotations

import json
from pathlib import Path

import imagecodecs
import numpy as np

from skindb.hw.cameras import FolderCameras
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.probe import Probe
from skindb.hw.safety import Override
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults

LIGHTS = [f"l{i:02d}" for i in range(12)]
CAMERAS = ["c0", "c1"]
EXPOSURES = {"long": 0.04, "short": 0.005}
BRACKETS = {f"b{i:02d}": 0.2 / 2**i for i in range(5)}
BLACK = 256
SPEED = 10.0
OVERRIDE = Override("OP-1", "2026-01-01T10:00:00+00:00")


def value_of(light: str, camera: str, exposure: str) -> int:
    """The value of all pixels of a frame: different for each."""
    return BLACK + (100 + 37 * LIGHTS.index(light) + 11 * CAMERAS.index(camera)) * (8 if exposure == "long" else 1)


def _save(path: Path, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(np.full((4, 6, 3), value, np.uint16)))


def subject_folder(folder: Path) -> Path:
    """What the cameras of the laboratory see."""
    for exposure in EXPOSURES:
        for camera in CAMERAS:
            _save(folder / f"dome/dark/{exposure}_{camera}.png", BLACK)
            for light in LIGHTS:
                _save(folder / f"dome/frames/{exposure}/{light}_{camera}.png", value_of(light, camera, exposure))
    for site in ("cheek", "neck"):
        for number, bracket in enumerate(BRACKETS):
            _save(folder / f"contact/{site}/{bracket}.png", 1000 * (1 + number) + (site == "neck"))
    sensor = {"width": 6, "height": 4, "black_level": BLACK, "bit_depth": 16}
    pose = {"R": np.diag([1, -1, -1]).tolist(), "t": [0, 0, 500]}
    cameras = [{"id": name} | sensor | pose for name in CAMERAS]
    dome = {
        "cameras": cameras,
        "lights": [{"id": light, "position": [0, 0, 500]} for light in LIGHTS],
        "exposures": [{"id": name, "seconds": seconds} for name, seconds in EXPOSURES.items()],
        "frames": "dome/frames/{exposure}/{light}_{camera}.png",
        "dark": "dome/dark/{exposure}_{camera}.png",
    }
    probe = {
        "exposures": [{"id": name, "seconds": seconds} for name, seconds in BRACKETS.items()],
        "fibres": [{"id": "f0", "distance": 1.0, "centre": [3, 2], "radius": 1}],
        "sites": ["cheek", "neck"],
        "frames": "contact/{site}/{exposure}.png",
    }
    (folder / "dome/dome.json").write_text(json.dumps(dome))
    (folder / "contact/probe.json").write_text(json.dumps(probe))
    return folder


class Bench:
    """A laboratory and the drivers that are connected to it."""

    def __init__(self, subject: Path, watched: Path, faults: LaboratoryFaults | None = None, log: Path | None = None):
        self.laboratory = Laboratory(subject, watched, faults, speed=SPEED, probe_speed=SPEED)
        self.watched, self.log = watched, log

    def __enter__(self) -> Bench:
        self.laboratory.__enter__()
        self.dome = Dome(Link(open_port(self.laboratory.dome_url), "dome", log=self.log))
        self.probe = Probe(Link(open_port(self.laboratory.probe_url), "probe"))
        self.cameras = FolderCameras(self.watched, CAMERAS, quiet=0.3)
        self.probe_camera = FolderCameras(self.watched, ["probe"], quiet=0.3)
        return self

    def __exit__(self, *_: object) -> None:
        self.dome.link.close()
        self.probe.link.close()
        self.laboratory.__exit__()

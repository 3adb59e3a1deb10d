"""A virtual laboratory around a small made-up subject, in simulated time."""

from __future__ import annotations

import json
from pathlib import Path

import imagecodecs
import numpy as np

from skindb.clock import SimulatedClock
from skindb.hw.cameras import FolderCameras
from skindb.hw.dome import Dome
from skindb.hw.link import Link
from skindb.hw.probe import Probe
from skindb.hw.sequence import Override
from skindb.hw.session import capture_dome
from skindb.virtual.devices import DeviceFaults, DirectPort, Emulated, EmulatedDome
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults

LIGHTS = [f"l{i:02d}" for i in range(12)]
CAMERAS = ["c0", "c1"]
EXPOSURES = {"long": 0.04, "short": 0.005}
BRACKETS = {f"b{i:02d}": 0.2 / 2**i for i in range(5)}
BLACK = 256
OVERRIDE = Override("OP-1", "2026-01-01T10:00:00+00:00")


def value_of(light: str, camera: str, exposure: str) -> int:
    """The value of all pixels of a frame: different for each."""
    return BLACK + (100 + 37 * LIGHTS.index(light) + 11 * CAMERAS.index(camera)) * (
        8 if exposure == "long" else 1
    )


def is_frame(found: np.ndarray, value: int) -> bool:
    """Whether a frame has this value: others differ by 11 at least, and a picture that is
    taken again has noise with a standard deviation of one.
    """
    return bool(np.abs(found.astype(float) - value).max() < 5.5)


def _save(path: Path, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(np.full((4, 6, 3), value, np.uint16)))


def subject_folder(folder: Path) -> Path:
    """What the cameras of the laboratory see."""
    for exposure in EXPOSURES:
        for camera in CAMERAS:
            _save(folder / f"dome/dark/{exposure}_{camera}.png", BLACK)
            for light in LIGHTS:
                _save(
                    folder / f"dome/frames/{exposure}/{light}_{camera}.png",
                    value_of(light, camera, exposure),
                )
    for site in ("cheek", "neck"):
        for number, bracket in enumerate(BRACKETS):
            _save(
                folder / f"contact/{site}/{bracket}.png",
                1000 * (1 + number) + (site == "neck"),
            )
    sensor = {"width": 6, "height": 4, "black_level": BLACK, "bit_depth": 16}
    sensor["K"] = [[100, 0, 3], [0, 100, 2], [0, 0, 1]]
    pose = {"R": np.diag([1, -1, -1]).tolist(), "t": [0, 0, 500]}
    cameras = [{"id": name} | sensor | pose for name in CAMERAS]
    dome = {
        "cameras": cameras,
        "lights": [{"id": light, "position": [0, 0, 500]} for light in LIGHTS],
        "exposures": [
            {"id": name, "seconds": seconds} for name, seconds in EXPOSURES.items()
        ],
        "frames": "dome/frames/{exposure}/{light}_{camera}.png",
        "dark": "dome/dark/{exposure}_{camera}.png",
    }
    probe = {
        "exposures": [
            {"id": name, "seconds": seconds} for name, seconds in BRACKETS.items()
        ],
        "fibres": [{"id": "f0", "distance": 1.0, "centre": [3, 2], "radius": 1}],
        "sites": ["cheek", "neck"],
        "frames": "contact/{site}/{exposure}.png",
    }
    (folder / "dome/dome.json").write_text(json.dumps(dome))
    (folder / "contact/probe.json").write_text(json.dumps(probe))
    return folder


class Bench:
    """A laboratory and the drivers that are connected to it, with a simulated clock."""

    def __init__(
        self,
        subject: Path,
        watched: Path,
        faults: LaboratoryFaults | None = None,
        *,
        log: Path | None = None,
    ):
        self.clock = SimulatedClock()
        self.laboratory = Laboratory(subject, watched, faults, clock=self.clock)
        self.watched = watched
        self.dome = Dome(
            Link(self.laboratory.port("dome"), "dome", clock=self.clock, log=log)
        )
        self.probe = Probe(
            Link(self.laboratory.port("probe"), "probe", clock=self.clock)
        )
        self.cameras = FolderCameras(watched, CAMERAS, clock=self.clock)
        self.probe_camera = FolderCameras(watched, ["probe"], clock=self.clock)

    def capture(self, schedule, **options):
        """Run a schedule, which an operator confirms by default."""
        options = {"override": OVERRIDE, "marker_light": LIGHTS[0]} | options
        return capture_dome(self.dome, self.cameras, schedule, **options)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log of the controller."""
        self.dome.link.close()


def linked(device: Emulated, name: str = "dome") -> Link:
    """Link to an emulated device that has a simulated clock."""
    return Link(DirectPort(device, device.clock), name, clock=device.clock)


def emulated_dome(faults: DeviceFaults | None = None) -> EmulatedDome:
    """A controller without cameras."""
    return EmulatedDome(tuple(LIGHTS), lambda *_: None, faults, clock=SimulatedClock())

"""A virtual laboratory: emulated devices around a virtual subject, and cameras that
write its frames into folders.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from skindb.clock import Clock, SimulatedClock
from skindb.virtual.devices import DeviceFaults, DirectPort, EmulatedDome, EmulatedProbe

LAMP_LIGHTS = 8  # among which the brightest one in a camera is looked for
# arbitrary wall time, as cameras do not know when the controller started
FIRST_FRAME_TIME = 1_700_000_000.0


@dataclass(frozen=True)
class LaboratoryFaults:
    """Faults of a laboratory; none by default."""

    dome: DeviceFaults = field(default_factory=DeviceFaults)
    probe: DeviceFaults = field(default_factory=DeviceFaults)
    # camera and number of the trigger, counted from 0
    dropped_frames: tuple[tuple[str, int], ...] = ()
    dropped_probe_frames: tuple[int, ...] = ()
    hot_pixels: int = 0  # number in the first camera, at the white level in every frame
    lamp: float = 1.0  # brightness of the steady lamp relative to the stated one


class Laboratory:
    """Emulated devices that reproduce a capture.

    Parameters
    ----------
    subject
        Folder of a complete capture with PNG frames, simulated or not, which the
        cameras deliver again.
    watched
        Folder for the frames, emptied at the start, with a folder for each camera and
        `probe` for that of the probe.
    faults
        Simulated faults.
    clock
        Clock of the devices; by default a simulated one.
    lamp
        Brightness of a steady lamp, in every camera in units of the brightest light.
    """

    def __init__(
        self,
        subject: Path,
        watched: Path,
        faults: LaboratoryFaults | None = None,
        *,
        clock: Clock | None = None,
        lamp: float = 0.0,
    ) -> None:
        self.subject = subject
        self.watched = watched
        self.clock = clock or SimulatedClock()
        self.faults = faults or LaboratoryFaults()
        self._record: dict[str, Any] = json.loads(
            (subject / "dome/dome.json").read_text(encoding="utf-8")
        )
        self.cameras = tuple(str(camera["id"]) for camera in self._record["cameras"])
        self.site = ""  # current site of the probe
        self._triggers = dict.fromkeys((*self.cameras, "probe"), 0)
        self._hot = self._hot_pixels()
        self._lamp = lamp * self.faults.lamp
        lit = self.cameras if self._lamp else ()
        self._brightest = {camera: self._brightest_light(camera) for camera in lit}
        lights = tuple(str(light["id"]) for light in self._record["lights"])
        self.dome = EmulatedDome(
            lights, self._photograph, self.faults.dome, clock=self.clock
        )
        self.probe = EmulatedProbe(
            self._probe_photograph, self.faults.probe, clock=self.clock
        )
        shutil.rmtree(watched, ignore_errors=True)  # frames of an earlier session
        for name in self._triggers:
            (watched / name).mkdir(parents=True, exist_ok=True)

    def port(self, device: str) -> DirectPort:
        """The line to a device, "dome" or "probe", without a cable and in simulated time."""
        if not isinstance(self.clock, SimulatedClock):
            raise TypeError(
                "a laboratory with a real clock must be served at a real port"
            )
        return DirectPort(self.dome if device == "dome" else self.probe, self.clock)

    def place(self, site: str) -> None:
        """Put the probe on a site of the subject."""
        self.site = site

    def _photograph(
        self, exposure: str, factors: dict[str, float], seconds: float
    ) -> None:
        """Every camera takes a frame under these lights, each with its factor."""
        for camera in self.cameras:
            number = self._count(camera)
            if (camera, number) in self.faults.dropped_frames:
                continue
            target = self.watched / camera / f"IMG_{number:05d}.png"
            lit = {name: factor for name, factor in factors.items() if name != "-"}
            if self._lamp:
                name = self._brightest[camera]
                lit[name] = lit.get(name, 0.0) + self._lamp
            self._write(target, camera, exposure, lit, FIRST_FRAME_TIME + seconds)

    def _write(
        self,
        target: Path,
        camera: str,
        exposure: str,
        factors: dict[str, float],
        stamp: float,
    ) -> None:
        """Write a frame atomically, like tethering tools, which rename a file when it
        is complete.
        """
        whole = target.with_suffix(".part")
        self._expose(whole, camera, exposure, factors)
        os.utime(whole, (stamp, stamp))
        whole.rename(target)

    def _expose(
        self, target: Path, camera: str, exposure: str, factors: dict[str, float]
    ) -> None:
        dark = self._source("dark", camera, exposure)
        if [*factors.values()] == [1.0] and not (
            len(self._hot) and camera == self.cameras[0]
        ):
            shutil.copyfile(
                self._required("frames", camera, exposure, next(iter(factors))), target
            )
            return
        record = next(one for one in self._record["cameras"] if one["id"] == camera)
        black = float(record.get("black_level", 0.0))
        white = float(record.get("white_level", 2 ** record.get("bit_depth", 16) - 1))
        value = (
            np.full((record["height"], record["width"], 3), black)
            if dark is None
            else _read(dark)
        )
        base = value.copy()
        for light, factor in factors.items():
            value += factor * (
                _read(self._required("frames", camera, exposure, light)) - base
            )
        if camera == self.cameras[0]:
            value[self._hot[:, 0], self._hot[:, 1]] = white
        png = imagecodecs.png_encode(
            np.clip(np.rint(value), 0, white).astype(np.uint16)
        )
        target.write_bytes(png)

    def _brightest_light(self, camera: str) -> str:
        """The light that looks brightest in a camera; it is one of those nearest to it."""
        record = next(one for one in self._record["cameras"] if one["id"] == camera)
        exposure = min(
            self._record["exposures"], key=lambda one: float(one["seconds"])
        )["id"]
        centre = -np.array(record["R"]).T @ np.array(record["t"])
        places = np.array(
            [light["position"] for light in self._record["lights"]], np.float64
        )
        nearest = np.argsort(-places @ centre / np.linalg.norm(places, axis=1))[
            :LAMP_LIGHTS
        ]
        names = [str(self._record["lights"][i]["id"]) for i in nearest]
        frames = {
            name: _read(self._required("frames", camera, exposure, name))
            for name in names
        }
        return max(
            names, key=lambda name: float(np.quantile(frames[name].mean(axis=-1), 0.9))
        )

    def _source(
        self, key: str, camera: str, exposure: str, light: str = ""
    ) -> Path | None:
        template = str(self._record.get(key) or "")
        if not template:
            return None
        name = (
            template.replace("{camera}", camera)
            .replace("{exposure}", exposure)
            .replace("{light}", light)
        )
        return self.subject / name

    def _required(self, key: str, camera: str, exposure: str, light: str) -> Path:
        path = self._source(key, camera, exposure, light)
        if path is None:
            raise KeyError(key)
        return path

    def _probe_photograph(self, exposure: str) -> None:
        number = self._count("probe")
        if number in self.faults.dropped_probe_frames:
            return
        record = json.loads(
            (self.subject / "contact/probe.json").read_text(encoding="utf-8")
        )
        own = record.get("placements", {}).get(self.site) or [""]
        name = (
            record["frames"]
            .replace("{site}", self.site)
            .replace("{exposure}", exposure)
        )
        name = name.replace("{placement}", str(own[0]))
        shutil.copyfile(
            self.subject / name, self.watched / "probe" / f"IMG_{number:05d}.png"
        )

    def _count(self, camera: str) -> int:
        self._triggers[camera] += 1
        return self._triggers[camera] - 1

    def _hot_pixels(self) -> NDArray[np.int64]:
        camera = self._record["cameras"][0]
        rng = np.random.default_rng(self.faults.dome.seed)
        high = [camera["height"], camera["width"]]
        return rng.integers(0, high, (self.faults.hot_pixels, 2))


def _read(path: Path) -> NDArray[np.float64]:
    return np.asarray(imagecodecs.png_decode(path.read_bytes()), np.float64)

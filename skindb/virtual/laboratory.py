"""A virtual laboratory: emulated devices around a virtual subject, and cameras that
write its frames into folders.
"""

from __future__ import annotations

import json
import shutil
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from skindb.clock import Clock, SimulatedClock
from skindb.errors import input_error
from skindb.format.frames import filled
from skindb.types import Float64, float64
from skindb.virtual.devices import (
    GAUGE_FAULTS,
    DeviceFaults,
    DirectPort,
    EmulatedDome,
    EmulatedProbe,
)
from skindb.virtual.dome import write_png
from skindb.virtual.targets import TargetScene

PROBABILITIES = ("garbage", "lost_replies")  # of `DeviceFaults`
MAX_FAULT = 1e6  # of any number of a fault


@dataclass(frozen=True)
class LaboratoryFaults:
    """Faults of a laboratory; none by default."""

    dome: DeviceFaults = field(default_factory=DeviceFaults)
    probe: DeviceFaults = field(default_factory=DeviceFaults)
    # camera and number of the trigger, counted from 0
    dropped_frames: tuple[tuple[str, int], ...] = ()
    dropped_probe_frames: tuple[int, ...] = ()
    repeated_frames: tuple[tuple[str, int], ...] = ()  # delivered twice
    late_seconds: float = 0.0  # after the exposure, when a frame is in its folder


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
    scene
        Calibration targets, which the cameras see in place of the subject; of the folder,
        only dome/dome.json is used then.
    """

    def __init__(
        self,
        subject: Path,
        watched: Path,
        faults: LaboratoryFaults | None = None,
        *,
        clock: Clock | None = None,
        scene: TargetScene | None = None,
    ) -> None:
        self.scene = scene
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
        self._files = dict.fromkeys(self.cameras, 0)
        self._rng = np.random.default_rng(0)
        self._copied = set[Path]()  # pictures that were delivered without new noise
        self._late = deque[tuple[float, Path, Path]]()  # when, file, its final name
        if isinstance(self.clock, SimulatedClock):
            self.clock.attach(self._deliver)
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

    def _photograph(self, exposure: str, factors: dict[str, float]) -> None:
        """Every camera takes a frame under these lights, each with its factor."""
        lit = {name: factor for name, factor in factors.items() if name != "-"}
        for camera in self.cameras:
            number = self._count(camera)
            if (camera, number) in self.faults.dropped_frames:
                continue
            partial = self._queue(camera)
            self._expose(partial, camera, exposure, lit)
            if (camera, number) in self.faults.repeated_frames:
                shutil.copyfile(partial, self._queue(camera))
        self._deliver()

    def _queue(self, camera: str) -> Path:
        """Path to which the next frame of a camera is written, like a tethering tool does,
        which renames the file when it is complete.
        """
        target = self.watched / camera / f"IMG_{self._files[camera]:05d}.png"
        self._files[camera] += 1
        partial = target.with_suffix(".part")
        due = self.clock.monotonic() + self.faults.late_seconds
        self._late.append((due, partial, target))
        return partial

    def _deliver(self) -> None:
        """Give the frames that are due their final names."""
        while self._late and self._late[0][0] <= self.clock.monotonic():
            _, partial, target = self._late.popleft()
            partial.rename(target)

    def _expose(
        self, target: Path, camera: str, exposure: str, factors: dict[str, float]
    ) -> None:
        if self.scene is not None:
            write_png(target, self.scene.frame(camera, exposure, factors))
            return
        dark = self._source("dark", camera, exposure)
        if [*factors.values()] == [1.0]:
            source = self._required(camera, exposure, next(iter(factors)))
            if source not in self._copied:
                self._copied.add(source)
                shutil.copyfile(source, target)
                return
        record = next(
            entry for entry in self._record["cameras"] if entry["id"] == camera
        )
        black = float(record.get("black_level", 0.0))
        white = float(record.get("white_level", 2 ** record.get("bit_depth", 16) - 1))
        value = (
            np.full((record["height"], record["width"], 3), black)
            if dark is None
            else _read(dark)
        )
        base = value.copy()
        for light, factor in factors.items():
            value += factor * (_read(self._required(camera, exposure, light)) - base)
        # noise of reading: no two frames of a sensor are equal
        value += self._rng.standard_normal(value.shape)
        png = imagecodecs.png_encode(
            np.clip(np.rint(value), 0, white).astype(np.uint16)
        )
        target.write_bytes(png)

    def _source(
        self, key: str, camera: str, exposure: str, light: str = ""
    ) -> Path | None:
        template = str(self._record.get(key) or "")
        if not template:
            return None
        name = filled(template, camera=camera, exposure=exposure, light=light)
        return self.subject / name

    def _required(self, camera: str, exposure: str, light: str) -> Path:
        path = self._source("frames", camera, exposure, light)
        if path is None:
            raise KeyError("frames")
        return path

    def _probe_photograph(self, exposure: str) -> None:
        number = self._count("probe")
        if number in self.faults.dropped_probe_frames:
            return
        record = json.loads(
            (self.subject / "contact/probe.json").read_text(encoding="utf-8")
        )
        placements = record.get("placements", {}).get(self.site) or [""]
        names = {"exposure": exposure, "placement": str(placements[0])}
        name = filled(record["frames"], site=self.site, **names)
        shutil.copyfile(
            self.subject / name, self.watched / "probe" / f"IMG_{number:05d}.png"
        )

    def _count(self, camera: str) -> int:
        self._triggers[camera] += 1
        return self._triggers[camera] - 1


def _read(path: Path) -> Float64:
    return float64(imagecodecs.png_decode(path.read_bytes()))


def laboratory_faults(
    texts: Sequence[str], lights: Collection[str], cameras: Collection[str]
) -> LaboratoryFaults | None:
    """Faults from texts NAME=VALUE: those of `DeviceFaults` for dome or probe, and
    dropped frames; None if there are no texts.

    Parameters
    ----------
    texts
        The faults.
    lights, cameras
        Ids of the laboratory.

    Raises
    ------
    InputError
        For a fault that does not exist or can never happen.
    """
    kinds = {spec.name: str(spec.type) for spec in fields(DeviceFaults)}
    devices: dict[str, dict[str, Any]] = {"dome": {}, "probe": {}}
    frames: dict[str, list[tuple[str, int]]] = {
        "dropped_frame": [],
        "repeated_frame": [],
    }
    late = 0.0
    for text in texts:
        name, _, value = text.partition("=")
        device, _, fault = name.rpartition(".")
        try:
            if name in frames:
                camera, number = value.split(":")
                frames[name].append((_word(camera, cameras), _count(number)))
            elif name == "late_seconds":
                late = _number(value)
            else:
                setting = _fault_value(fault, kinds[fault], value, lights)
                devices[device][fault] = setting
        except (ValueError, KeyError):
            names = ", ".join(f"dome.{n}" for n in kinds)
            raise input_error(
                "--fault",
                "must be dropped_frame=CAMERA:NUMBER, repeated_frame=CAMERA:NUMBER, "
                f"late_seconds=SECONDS, {names}, or the same with probe",
                repr(text),
                "numbers are not negative, probabilities at most 1, lights and cameras "
                "those of the set-up",
            ) from None
    if not texts:
        return None
    dome, probe = (DeviceFaults(**settings) for settings in devices.values())
    dropped, repeated = (tuple(numbers) for numbers in frames.values())
    return LaboratoryFaults(dome, probe, dropped, (), repeated, late)


def _fault_value(fault: str, kind: str, value: str, lights: Collection[str]) -> Any:
    """The value of a fault of a device; ValueError if it can never happen."""
    if kind.startswith("tuple"):
        return tuple(map(_count, value.split(":")))
    if kind == "str":
        return _word(value, GAUGE_FAULTS if fault == "gauge" else lights)
    if kind == "int":
        return _count(value)
    return _number(value, 1.0 if fault in PROBABILITIES else MAX_FAULT)


def _number(text: str, maximum: float = MAX_FAULT) -> float:
    number = float(text)
    if not 0.0 <= number <= maximum:
        raise ValueError(text)
    return number


def _word(text: str, words: Collection[str]) -> str:
    if text not in words:
        raise ValueError(text)
    return text


def _count(text: str) -> int:
    number = int(text)
    if number < 0 or number > MAX_FAULT:
        raise ValueError(text)
    return number

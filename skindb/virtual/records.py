"""The JSON of a virtual capture folder."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from skindb.virtual.dome import CENTRE, Dome
from skindb.virtual.frames import (
    DARK,
    EXPOSURES,
    FRAMES,
    SECONDS,
    TARGET_HALF_SIZE,
    TARGET_NORMAL,
    TARGET_REFLECTANCE,
    WHITE,
    frontal_camera,
)
from skindb.virtual.person import CONDITIONS, Person
from skindb.virtual.sensor import Sensor


def session_time(person: Person) -> datetime:
    """A fixed time that depends only on the person and the condition."""
    days = person.seed % 365
    minutes = 40 * CONDITIONS.index(person.condition)
    return datetime(2005, 1, 10, 9, 0, tzinfo=UTC) + timedelta(
        days=days, minutes=minutes
    )


def capture_record(person: Person, *, contact: bool, landmarks: bool) -> dict[str, Any]:
    """capture.json."""
    traits = {
        "age": person.age,
        "gender": person.gender,
        "ancestry": person.ancestry,
        "beard_density": person.beard_density,
        "freckles": person.freckles,
    }
    record: dict[str, Any] = {
        "format": "skindb-capture",
        "version": 1,
        "subject": person.subject,
        "session": session_time(person).isoformat(),
        "condition": person.condition,
        "traits": traits,
        "consent": {
            "scope": ["fit", "statistics", "export", "publish"],
            "reference": "virtual-no-person",
        },
        "mesh": "scan.ply",
        "regions": "regions.json",
        "dome": "dome/dome.json",
        "virtual": True,
        "seed": person.seed,
    }
    if landmarks:
        record["landmarks"] = "landmarks.json"
    if contact:
        record["contact"] = "contact/probe.json"
    return record


def dome_record(dome: Dome, sensor: Sensor, start: datetime) -> dict[str, Any]:
    """Content of dome/dome.json, without the intensities of the lights, which the white
    target determines.
    """
    cameras = [
        {
            "id": c.name,
            "width": c.width,
            "height": c.height,
            "K": c.matrix.tolist(),
            "R": c.rotation.tolist(),
            "t": c.translation.tolist(),
            "distortion": c.distortion.tolist(),
            "bit_depth": 16,
            "black_level": sensor.black,
            "white_level": sensor.white,
            "response": "linear",
            "read_noise_e": sensor.read_noise if sensor.noisy else 0.0,
            "electrons_per_dn": sensor.electrons_per_dn,
            "colour_matrix": np.eye(3).tolist(),
            "vignette": c.vignette.tolist(),
        }
        for c in dome.cameras
    ]
    lights = [
        {
            "id": light.name,
            "position": light.position.tolist(),
            "disc_radius": light.disc_radius,
            "intensity": None,  # determined by the white target
            "axis": light.axis.tolist(),
            "falloff": 0.0,
        }
        for light in dome.lights
    ]
    return {
        "cameras": cameras,
        "lights": lights,
        "exposures": [
            {"id": e, "seconds": s} for e, s in zip(EXPOSURES, SECONDS, strict=True)
        ],
        "frames": FRAMES,
        "dark": DARK,
        "white": {
            "frames": WHITE,
            "reflectance": TARGET_REFLECTANCE,
            "point": CENTRE.tolist(),
            "normal": TARGET_NORMAL.tolist(),
            "half_size": TARGET_HALF_SIZE,
            "cameras": [frontal_camera(dome).name],
        },
        "sequence": _sequence(dome, start),
    }


def _sequence(dome: Dome, start: datetime) -> list[dict[str, Any]]:
    """Lights one after the other at 12 Hz, once per exposure."""
    out = []
    for e, seconds in enumerate(SECONDS):
        for i, light in enumerate(dome.lights):
            on = start + timedelta(milliseconds=83 * (e * len(dome.lights) + i))
            out.append(
                {
                    "light": light.name,
                    "exposure": EXPOSURES[e],
                    "t_on": on.isoformat(timespec="milliseconds"),
                    "t_off": (on + timedelta(seconds=seconds)).isoformat(
                        timespec="milliseconds"
                    ),
                    "trigger_count": e * len(dome.lights) + i + 1,
                }
            )
    return out

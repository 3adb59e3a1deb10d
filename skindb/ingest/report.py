"""Attributes of a version of kind "capture": its provenance (subject, consent, digests of
the files), and a report with the repairs of the scan and the number of samples by
surfel, region, camera and light.
"""

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.files import Attributes, Json, file_digest
from skindb.format.dome import DomeRecord
from skindb.format.folder import WHOLE_SURFACE, Capture
from skindb.format.frames import Digests
from skindb.ingest.lumitexels import Lumitexels
from skindb.ingest.surfels import SurfelSet
from skindb.types import Index32

FRAMES = "frames"  # name of the digest over all frames
QUANTILES = {"p5": 0.05, "p50": 0.5, "p95": 0.95, "max": 1.0}
COLUMNS = ("mean", *QUANTILES, "seen")


def capture_provenance(
    capture: Capture, parameters: Attributes, digests: Digests
) -> Json:
    """Attributes of the version's root and its record; paths are those inside the folder.

    `digests` are those of the frames read so far. The digest of all frames is computed
    from them in the order of their paths, as the frames are decoded in any order.
    """
    inputs = {
        file.relative_to(capture.folder).as_posix(): file_digest(file)
        for file in _files(capture)
    }
    dome = capture.dome
    files = set()
    if dome is not None:
        files.update(dome.frame_files("frames", "dark", "white"))
    if capture.probe is not None:
        files.update(capture.probe.frame_files())
    frames = sorted(files)
    if frames:
        frame_digests = [digests.get(path) or file_digest(path) for path in frames]
        inputs[FRAMES] = hashlib.sha256("".join(frame_digests).encode()).hexdigest()
    crop = {} if capture.crop is None else {"crop": asdict(capture.crop)}
    by = capture.calibrated_by
    calibrated = {"calibrated_by": dict(by)} if by else {}
    optional = {
        "calibration": capture.calibration,
        **calibrated,
        "override": dict(capture.override),
        "relative_exposure": 0.0 if dome is None else dome.relative_exposure,
    }
    return {
        "subject": capture.subject,
        "condition": capture.condition,
        "session": capture.session,
        "traits": dict(capture.traits),
        "consent_scope": list(capture.consent_scope),
        "consent_reference": capture.consent_reference,
        **{key: value for key, value in optional.items() if value},
        "command": "ingest",
        "parameters": {**parameters, **crop, **calibrated},
        "seeds": {},
        "inputs": inputs,
        "frame_count": len(frames),
        "skipped": list(capture.skipped),
        "cleaning": dict(capture.surface.report),
        # mm
        "cleaning_places": {
            kind: np.round(points, 2).tolist()
            for kind, points in capture.surface.places.items()
        },
        "attributes": dict(capture.attributes),
        "unknown_keys": list(capture.unknown_keys),
    }


def _files(capture: Capture) -> list[Path]:
    """All files of a capture except frames."""
    cameras = () if capture.dome is None else capture.dome.cameras
    tables = {camera.sensor.response_file for camera in cameras}
    files = {capture.mesh_file, *tables}
    return [*capture.json_files, *sorted(file for file in files if file is not None)]


def cleaning_lines(provenance: Attributes, *, places: bool) -> list[str]:
    """A line for every kind of repair, optionally with the `places` of the first ones,
    x y z in mm.
    """
    points = provenance.get("cleaning_places", {}) if places else {}
    lines = []
    for kind, count in provenance.get("cleaning", {}).items():
        lines.append(f"{kind}: {count}")
        listed = points.get(kind, [])
        lines += [f"  at {x:.2f} {y:.2f} {z:.2f}" for x, y, z in listed]
        if kind in points and count > len(listed):
            lines.append(f"  and {count - len(listed):,} more")
    return lines


def describe_samples(
    lumitexels: Lumitexels, surfels: SurfelSet, dome: DomeRecord
) -> Json:
    """Samples per sampled surfel and fraction of sampled surfels, also by region;
    devices without samples.
    """
    count = lumitexels.counts[0]
    views = lumitexels.view_count
    parts = {WHOLE_SURFACE: _quantiles(count)}
    for name, region in zip(surfels.region_names, surfels.region.T, strict=True):
        parts[name] = _quantiles(count[region])
    cameras = dome.camera_ids
    lights = zip(dome.lights, views.sum(axis=1), strict=True)
    return {
        "of": int(views.size),
        "surfels": len(count),
        "parts": parts,
        "cameras": dict(zip(cameras, views.sum(axis=0).tolist(), strict=True)),
        "lights_without": [light.id for light, number in lights if number == 0],
    }


def sample_lines(samples: Attributes) -> list[str]:
    """Summary of the samples, and a line for every camera and light without a sample."""
    face = samples["parts"][WHOLE_SURFACE]
    quantiles = ", ".join(f"{name} {face[name]:,}" for name in QUANTILES)
    summary = (
        f"samples per surfel: mean {face['mean']:,} ({quantiles}) of {samples['of']:,}; "
        f"{face['seen']:.0%} of {samples['surfels']:,} surfels have any"
    )
    cameras = [name for name, number in samples["cameras"].items() if number == 0]
    return [
        summary,
        *[f"camera {name}: no sample" for name in cameras],
        *[f"light {name}: no sample" for name in samples["lights_without"]],
    ]


def calibration_lines(calibration: xr.Dataset) -> list[str]:
    """Agreement of photographs, scan and calibration, in one line."""
    if not np.isfinite(calibration["camera_agreement"]).any():
        return ["calibration: not checked, as the photographs show too little"]
    shift = float(np.linalg.norm(calibration["scan_translation_error"]))
    turn = float(np.linalg.norm(calibration["scan_rotation_error"]))
    return [
        f"calibration: scan {shift:.1f} mm and {turn:.1f} degrees from where the "
        "photographs show the face; "
        f"cameras up to {float(calibration['camera_offset'].max()):.1f} mm off; "
        f"lights agree by {float(calibration['light_agreement'].min()):.2f} or more"
    ]


def calibration_table(calibration: xr.Dataset) -> list[list[Any]]:
    """Header and rows: offset [mm] and scale [%] of each camera, agreement and
    brightness of cameras and lights.
    """
    rows = [["device", "offset [mm]", "larger by [%]", "agreement", "brightness"]]
    for name in calibration["camera"].values:
        camera = calibration.sel(camera=name)
        brightness = camera["camera_brightness"].values
        rows.append(
            [
                f"camera {name}",
                f"{float(camera['camera_offset']):.2f}",
                f"{100 * float(camera['camera_scale_error']):.1f}",
                f"{float(camera['camera_agreement']):.3f}",
                " ".join(f"{factor:.2f}" for factor in brightness),
            ]
        )
    for name in calibration["light"].values:
        light = calibration.sel(light=name)
        agreement = f"{float(light['light_agreement']):.3f}"
        factor = f"{float(light['light_brightness']):.2f}"
        rows.append([f"light {name}", "-", "-", agreement, factor])
    return rows


def sample_table(samples: Attributes) -> list[list[Any]]:
    """Header and rows: samples per surfel, by region."""
    rows = [
        [name, *(part[column] for column in COLUMNS)]
        for name, part in samples["parts"].items()
    ]
    return [["samples of", *COLUMNS], *rows]


def _quantiles(count: Index32) -> dict[str, float]:
    sampled = count[count > 0]
    if not len(sampled):
        return dict.fromkeys(COLUMNS, 0)
    values = {
        name: round(float(np.quantile(sampled, q))) for name, q in QUANTILES.items()
    }
    return {
        "mean": round(float(sampled.mean())),
        **values,
        "seen": round(len(sampled) / len(count), 4),
    }

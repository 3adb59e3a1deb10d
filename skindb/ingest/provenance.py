"""Provenance of a version: subject, consent, and digests of the files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from skindb import __version__
from skindb.errors import require
from skindb.format.dome import DomeRecord
from skindb.format.folder import Capture
from skindb.format.frames import Digests

FRAMES = "frames"  # name of the digest over all frames


def require_fit_consent(capture: Capture) -> None:
    """Require the consent for fits, without which a capture is not ingested."""
    require(
        "fit" in capture.consent_scope,
        f"{capture.folder / 'capture.json'}[consent][scope]",
        "ingest needs the scope 'fit'",
        ", ".join(capture.consent_scope) or "nothing",
        "ask the subject, then correct it",
    )


def capture_provenance(
    capture: Capture, parameters: Mapping[str, Any], digests: Digests
) -> dict[str, Any]:
    """Attributes of the version's root and its record; paths are those inside the folder.

    `digests` are those of the frames read so far. The digest of all frames is computed
    from them in the order of their paths, as the frames are decoded in any order.
    """
    inputs = {
        file.relative_to(capture.folder).as_posix(): _sha256([file])
        for file in _files(capture)
    }
    files = set[Path]()
    if capture.dome is not None:
        files.update(capture.dome.frame_files("frames", "dark", "white"))
    if capture.probe is not None:
        files.update(capture.probe.frame_files())
    frames = sorted(files)
    if frames:
        frame_digests = [digests.get(path) or _sha256([path]) for path in frames]
        inputs[FRAMES] = hashlib.sha256("".join(frame_digests).encode()).hexdigest()
    optional = {
        "calibration": capture.calibration,
        "calibrated_by": dict(capture.calibrated_by or {}),
        "override": dict(capture.override),
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
        "parameters": _all_parameters(capture, parameters),
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


def samples_digest(capture: Capture, parameters: Mapping[str, Any]) -> str:
    """Digest of everything that samples depend on except face frames; white and dark
    frames enter by size and date.
    """
    dome = capture.dome
    record = {
        "version": __version__,
        "parameters": _all_parameters(capture, parameters),
        "rest": {} if dome is None else _marks(dome.frame_files("dark", "white")),
        "files": _sha256(_files(capture)),
    }
    text = json.dumps(record, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _files(capture: Capture) -> list[Path]:
    """All files of a capture except frames."""
    cameras = () if capture.dome is None else capture.dome.cameras
    tables = {camera.sensor.response_file for camera in cameras}
    files = [*capture.json_files, capture.mesh_file]
    return files + sorted(file for file in tables if file is not None)


def _all_parameters(capture: Capture, parameters: Mapping[str, Any]) -> dict[str, Any]:
    optional: dict[str, Any] = {}
    if capture.crop is not None:
        optional["crop"] = asdict(capture.crop)
    if capture.calibrated_by:
        optional["calibrated_by"] = dict(capture.calibrated_by)
    return {**parameters, **optional}


def frame_marks(dome: DomeRecord) -> dict[str, Any]:
    """Size and date of the frames of the face by path, to detect changes."""
    return _marks(dome.frame_files("frames"))


def _marks(paths: Iterable[Path]) -> dict[str, Any]:
    marks = {}
    for path in paths:
        status = path.stat()
        marks[str(path)] = [status.st_size, status.st_mtime_ns]
    return marks


def _sha256(files: Iterable[Path]) -> str:
    """One digest of the contents of files, which are read in blocks."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()

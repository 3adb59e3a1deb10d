"""Provenance of a version: subject, consent, and digests of the files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from skindb import __version__
from skindb.errors import Fault, InputError
from skindb.format.contact_probe import ProbeRecord
from skindb.format.dome import DomeRecord, promised_frames
from skindb.format.folder import Capture

FRAMES = "frames"  # name of the digest over all frames


def require_fit_consent(capture: Capture) -> None:
    """Require the consent for fits, without which a capture is not ingested."""
    if "fit" not in capture.consent_scope:
        where = f"{capture.folder / 'capture.json'}[consent][scope]"
        found = ", ".join(capture.consent_scope) or "nothing"
        raise InputError(
            Fault(
                where,
                "ingest needs the scope 'fit'",
                found,
                "ask the subject, then correct it",
            )
        )


def capture_provenance(
    capture: Capture,
    parameters: Mapping[str, Any],
    digests: Mapping[Path, str] | None = None,
) -> dict[str, Any]:
    """Attributes of the version's root and its record; paths are those inside the folder.

    `digests` are those of the frames read so far. The digest of all frames is computed
    from them in the order of their paths, as the frames are decoded in any order.
    """
    named = [*capture.json_files, capture.mesh_file, *_tables(capture.dome)]
    inputs = {
        file.relative_to(capture.folder).as_posix(): _sha256([file]) for file in named
    }
    frames = sorted({*_dome_frames(capture.dome), *_probe_frames(capture.probe)})
    if frames:
        known = digests or {}
        each = [known[path] if path in known else _sha256([path]) for path in frames]
        inputs[FRAMES] = hashlib.sha256("".join(each).encode()).hexdigest()
    return {
        "subject": capture.subject,
        "condition": capture.condition,
        "session": capture.session,
        "traits": dict(capture.traits),
        "consent_scope": list(capture.consent_scope),
        "consent_reference": capture.consent_reference,
        **({"calibration": capture.calibration} if capture.calibration else {}),
        **(
            {"calibrated_by": dict(capture.calibrated_by)}
            if capture.calibrated_by
            else {}
        ),
        **({"override": dict(capture.override)} if capture.override else {}),
        "command": "ingest",
        "parameters": _all_parameters(capture, parameters),
        "seeds": {},
        "inputs": inputs,
        "frame_count": len(frames),
        "skipped": list(capture.skipped),
        "cleaning": dict(capture.surface.report),
        # mm
        "cleaning_places": {
            kind: np.round(where, 2).tolist()
            for kind, where in capture.surface.places.items()
        },
        "attributes": dict(capture.attributes),
        "unknown_keys": list(capture.unknown_keys),
    }


def samples_digest(capture: Capture, parameters: Mapping[str, Any]) -> str:
    """Digest of everything that samples depend on except face frames; white and dark
    frames enter by size and date.
    """
    named = [*capture.json_files, capture.mesh_file, *_tables(capture.dome)]
    rest = {} if capture.dome is None else _marks(capture.dome, ("dark", "white"))
    record = {
        "version": __version__,
        "parameters": _all_parameters(capture, parameters),
        "rest": rest,
    }
    record["files"] = _sha256(named)
    return hashlib.sha256(
        json.dumps(record, sort_keys=True, default=str).encode()
    ).hexdigest()


def _all_parameters(capture: Capture, parameters: Mapping[str, Any]) -> dict[str, Any]:
    more = {} if capture.crop is None else {"crop": asdict(capture.crop)}
    return {
        **parameters,
        **more,
        **(
            {"calibrated_by": dict(capture.calibrated_by)}
            if capture.calibrated_by
            else {}
        ),
    }


def frame_marks(dome: DomeRecord) -> dict[str, Any]:
    """Size and date of the frames of the face by path, to detect changes."""
    return _marks(dome, ("frames",))


def _marks(dome: DomeRecord, keys: Collection[str]) -> dict[str, Any]:
    paths = [
        dome.folder / name for key, name, _ in promised_frames(dome) if key in keys
    ]
    return {
        str(path): [status.st_size, status.st_mtime_ns]
        for path in paths
        for status in [path.stat()]
    }


def _sha256(files: Iterable[Path]) -> str:
    """One digest of the contents of files, which are read in blocks."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _tables(dome: DomeRecord | None) -> list[Path]:
    return (
        []
        if dome is None
        else sorted(
            {c.sensor.response_file for c in dome.cameras if c.sensor.response_file}
        )
    )


def _dome_frames(dome: DomeRecord | None) -> list[Path]:
    return (
        []
        if dome is None
        else [dome.folder / name for _, name, _ in promised_frames(dome)]
    )


def _probe_frames(probe: ProbeRecord | None) -> list[Path]:
    return [] if probe is None else list(probe.frame_files())

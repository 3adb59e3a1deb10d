"""Where a version came from: who, with what consent, from which bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError
from skindb.ingest.devices import DomeRecord, ProbeRecord, promised_frames
from skindb.ingest.folder import Capture

FRAMES = "frames"  # name of the digest over all frames


def require_fit_consent(capture: Capture) -> None:
    """Nothing is taken in that may not be fitted."""
    if "fit" not in capture.consent_scope:
        where = f"{capture.folder / 'capture.json'}[consent][scope]"
        found = ", ".join(capture.consent_scope) or "nothing"
        raise InputError(Fault(where, "ingest needs the scope 'fit'", found, "ask the subject, then correct it"))


def capture_provenance(capture: Capture, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes of the version's root and its record; paths are those inside the folder."""
    named = [*capture.json_files, capture.mesh_file, *_tables(capture.dome)]
    inputs = {file.relative_to(capture.folder).as_posix(): _sha256([file]) for file in named}
    frames = sorted({*_dome_frames(capture.dome), *_probe_frames(capture.probe)})
    if frames:
        inputs[FRAMES] = _sha256(frames)
    return {
        "subject": capture.subject,
        "condition": capture.condition,
        "session": capture.session,
        "traits": dict(capture.traits),
        "consent_scope": list(capture.consent_scope),
        "consent_reference": capture.consent_reference,
        "command": "ingest",
        "parameters": {**parameters, **({} if capture.crop is None else {"crop": asdict(capture.crop)})},
        "seeds": {},
        "inputs": inputs,
        "frame_count": len(frames),
        "left_out": list(capture.left_out),
        "cleaning": dict(capture.surface.report),
        "attributes": dict(capture.attributes),
        "unknown_keys": list(capture.unknown_keys),
    }


def _sha256(files: Iterable[Path]) -> str:
    """One digest over the contents of files, each read in blocks."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _tables(dome: DomeRecord | None) -> list[Path]:
    return [] if dome is None else sorted({c.sensor.response_file for c in dome.cameras if c.sensor.response_file})


def _dome_frames(dome: DomeRecord | None) -> list[Path]:
    return [] if dome is None else [dome.folder / name for _, name, _ in promised_frames(dome)]


def _probe_frames(probe: ProbeRecord | None) -> list[Path]:
    return [] if probe is None else [probe.frame(site, e) for site, e in product(probe.sites, probe.exposures)]

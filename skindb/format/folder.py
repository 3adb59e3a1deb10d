"""Reading a capture folder (docs/capture_format.md, versions 1 and 2) as frozen
records, with all faults at once.
"""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.format.contact_probe import ProbeRecord, read_probe
from skindb.format.crop_file import crop_path, parsed_crop
from skindb.format.dome import DomeRecord, promised_frames, read_dome
from skindb.format.fields import IDENTIFIER, NAME, Fields
from skindb.format.frame_paths import decoding_faults, inside
from skindb.format.json_file import (
    CURE,
    MAX_MAGNITUDE,
    is_number,
    read_json,
    short,
    shown,
)
from skindb.format.length_units import (
    CAMERAS,
    LANDMARKS,
    LIGHTS,
    SCAN,
    SIZES,
    Lengths,
    device_faults,
    likely_units,
    unit_fault,
    unit_text,
)
from skindb.format.scan_checks import (
    SITE_LANDMARK,
    coincidence_faults,
    discarded_piece_faults,
    face_fault,
    face_height,
    landmark_faults,
    order_fault,
    scan_fault,
    swapped_faults,
)
from skindb.geometry.clean import CleanMesh, clean_mesh
from skindb.geometry.scan import Crop, Scan, crop_faces, read_scan
from skindb.limits import MAX_FRAMES, MAX_OBJECT_KEYS, MAX_REGIONS
from skindb.schema.cohort import imitates_column

FORMAT = "skindb-capture"
VERSIONS = (1, 2)
OVERRIDE = ("screened", "consented", "eyes_closed")  # what the operator confirms
SCOPES = ("fit", "statistics", "export", "publish")
WHOLE_SURFACE = "all"  # name of the entire surface in reports by region
SESSION_RULE = "must be an ISO 8601 time with its zone"
SESSION_CURE = "write it like 2005-01-10T09:00:00+01:00"
SIMULATED = ("virtual", "seed", "rehearsal")  # attributes of virtual captures


@dataclass(frozen=True)
class Capture:
    """Content of a capture folder; frames are decoded later."""

    folder: Path
    subject: str
    session: str
    condition: str
    traits: Mapping[str, Any]
    consent_scope: tuple[str, ...]
    consent_reference: str
    # name of the calibration in the database that applied; empty: the values of
    # dome.json
    calibration: str
    # confirmation of flashes above the limit for photosensitive seizures; may be empty
    override: Mapping[str, Any]
    mesh_file: Path
    scan: Scan
    surface: CleanMesh
    landmarks: Mapping[str, NDArray[np.float64]]  # (3,) mm
    regions: Mapping[str, NDArray[np.int64]]  # vertices of the scan
    dome: DomeRecord | None
    probe: ProbeRecord | None
    json_files: tuple[Path, ...]
    attributes: Mapping[str, Any]  # keys that the format does not define
    # those to report, with the key that may have been intended
    unknown_keys: tuple[str, ...]
    skipped: tuple[str, ...]  # missing parts, and the results that depend on them
    crop: Crop | None = None  # limits of the scan
    # version of the calibration that provides its lights
    calibrated_by: Mapping[str, Any] | None = None

    @property
    def take(self) -> str:
        """Name of the take: the subject, followed by the condition unless that is normal."""
        return (
            self.subject
            if self.condition == "normal"
            else f"{self.subject}.{self.condition}"
        )


def read_capture(path: str | Path, *, crop: Crop | None = None) -> Capture:
    """Read and check a capture folder.

    Parameters
    ----------
    path
        Folder with `capture.json`.
    crop
        Part of the scan to keep, after the complete scan has been checked; None for the
        box in the file beside the landmarks that `skindb landmarks` writes
        (`landmarks.crop.json`), or all of the scan if there is none.

    Returns
    -------
    Capture
        Every frame exists and has the declared size and depth according to its header.

    Raises
    ------
    InputError
        With every fault of the folder: file, key, rule and the value found.
    """
    folder = Path(path)
    faults = list[Fault]()
    file = folder / "capture.json"
    data = (
        read_json(file, faults)
        if inside(folder, file.name, str(file), faults)
        else None
    )
    if data is None:
        raise InputError(faults)
    fields = Fields(data, str(file), faults)
    _require_version(fields)
    reader = _Reader(folder, fields, faults, crop)
    capture = reader.capture()
    if faults or capture is None:
        faults += decoding_faults(reader.frame_files(), faults)
        raise InputError(faults)
    return capture


def record_faults(record: Mapping[str, Any]) -> list[Fault]:
    """Faults that `read_capture` would report for the values of `capture.json` that are
    not file names.
    """
    faults = list[Fault]()
    fields = Fields(dict(record), "capture.json", faults)
    _Reader(Path(), fields, faults, None).person()
    return faults


def _require_version(fields: Fields) -> None:
    """Require a known format and version; nothing else can be checked without them."""
    for key, known in (("format", (FORMAT,)), ("version", VERSIONS)):
        value = fields.get(key)
        if value is not None and (value not in known or isinstance(value, bool)):
            cure = "update skindb, or write this version"
            rule = " or ".join(map(json.dumps, known))
            fields.fault(
                key, f"must be {rule}, which this skindb reads", shown(value), cure
            )
            raise InputError(fields.faults)


class _Reader:
    """The files that `capture.json` names, one after the other."""

    def __init__(
        self, folder: Path, fields: Fields, faults: list[Fault], crop: Crop | None
    ) -> None:
        self.folder = folder
        self.fields = fields
        self.faults = faults
        self.crop = crop
        self.version = 1 if fields.data.get("version") == 1 else 2
        self.files = [folder / "capture.json"]
        self.skipped: list[str] = []
        self.sized = False  # the landmarks show that the scan is in mm
        self.unit_faults: list[Fault] = []  # lengths that cannot all be in mm
        self.dome: DomeRecord | None = None
        self.probe: ProbeRecord | None = None

    def capture(self) -> Capture | None:
        fields = self.fields
        person = self.person()
        mesh_file = self._path("mesh", required=True)
        scan, surface = self._mesh(mesh_file)
        landmarks = self._landmarks(scan, surface)
        regions = self._regions(scan, surface)
        self.dome, self.probe = self._dome(mesh_file, surface), self._probe()
        self._require_sites(landmarks, regions)
        if self.unit_faults and scan is not None:
            self.faults += (
                self._joint_unit_fault(mesh_file, scan, landmarks, regions)
                or self.unit_faults
            )
        if mesh_file is None or scan is None or surface is None:
            return None
        self.crop = self.crop or self._saved_crop()
        surface = self._cropped(mesh_file, scan, surface, landmarks)
        return Capture(
            folder=self.folder,
            **person,
            mesh_file=mesh_file,
            scan=scan,
            surface=surface,
            landmarks=landmarks,
            regions=regions,
            dome=self.dome,
            probe=self.probe,
            json_files=tuple(self.files),
            attributes=fields.rest(),
            unknown_keys=fields.unknown(besides=SIMULATED),
            skipped=tuple(self.skipped),
            crop=self.crop,
        )

    def person(self) -> dict[str, Any]:
        """Subject, session and consent: the values of `capture.json` that are not file names."""
        said: dict[str, Any] = {"subject": self.fields.text("subject", rule=NAME)}
        said["condition"] = self.fields.text("condition", rule=NAME, default="normal")
        said |= {"session": self._session(), "traits": self._traits()}
        said["consent_scope"], said["consent_reference"] = self._consent()
        return said | {"calibration": self._calibration(), "override": self._override()}

    def frame_files(self) -> Iterator[Path]:
        """All frames of the dome and of the probe, as far as these could be read."""
        dome = self.dome
        if dome is not None and dome.frame_count <= MAX_FRAMES:
            yield from (dome.folder / name for _, name, _ in promised_frames(dome))
        if self.probe is not None and self.probe.frames:
            yield from self.probe.frame_files()

    def _path(self, key: str, *, required: bool = False) -> Path | None:
        name = (
            self.fields.text(key)
            if required
            else self.fields.text(key, default="")
            if self._has(key)
            else ""
        )
        return (
            inside(self.folder, name, f"{self.fields.where}[{key}]", self.faults)
            if name
            else None
        )

    def _has(self, key: str) -> bool:
        return self.fields.get(key, None) is not None

    def _object(self, key: str, missing: str) -> Fields | None:
        """The JSON object of an optional file; a line in `skipped` if capture.json does
        not name the file.
        """
        if not self._has(key):
            self.skipped.append(f"{key}: not in capture.json; {missing}")
            return None
        path = self._path(key)
        if path is None:
            return None
        self.files.append(path)
        data = read_json(path, self.faults)
        return None if data is None else Fields(data, str(path), self.faults)

    def _session(self) -> str:
        text = self.fields.text("session")
        try:
            if text and datetime.fromisoformat(text).tzinfo is None:
                self.fields.fault("session", SESSION_RULE, shown(text), SESSION_CURE)
        except ValueError:
            self.fields.fault("session", SESSION_RULE, shown(text), SESSION_CURE)
        return text

    def _traits(self) -> dict[str, Any]:
        traits = Fields(
            self.fields.get("traits", {}), f"{self.fields.where}[traits]", self.faults
        )
        traits.at_most(MAX_OBJECT_KEYS, "traits")
        for name, value in traits.data.items():
            if imitates_column(name):
                rule = "an attribute must not have the name of another column of the catalogue"
                traits.fault(
                    name,
                    rule,
                    f"the name {short(name)}",
                    "rename it, for example skin_condition",
                )
            if isinstance(value, str):
                traits.require_printable(name, value)
            elif not isinstance(value, bool) and not (
                is_number(value) and abs(value) <= MAX_MAGNITUDE
            ):
                rule = (
                    f"a trait must be a number of at most {MAX_MAGNITUDE:g}, a text or "
                    "true/false"
                )
                traits.fault(name, rule, shown(value))
        return traits.data

    def _consent(self) -> tuple[tuple[str, ...], str]:
        given = self.fields.get("consent")
        if given is None:
            return (), ""
        consent = Fields(given, f"{self.fields.where}[consent]", self.faults)
        scope = consent.names("scope", least=0, most=len(SCOPES))
        if unknown := [name for name in scope if name not in SCOPES]:
            consent.fault(
                "scope", f"must be from {', '.join(SCOPES)}", short(", ".join(unknown))
            )
        return scope, consent.text("reference")

    def _calibration(self) -> str:
        return (
            self.fields.text("calibration", rule=NAME, default="")
            if self._named_in_version_2("calibration")
            else ""
        )

    def _override(self) -> dict[str, Any]:
        """The operator's confirmation of flashes above the limit, which is valid only
        if it is complete.
        """
        if not self._named_in_version_2("override"):
            return {}
        given = Fields(
            self.fields.get("override"), f"{self.fields.where}[override]", self.faults
        )
        operator = given.text("operator", rule=IDENTIFIER)
        time = given.text("time", default="")
        for key in OVERRIDE:
            if given.get(key) is not True and given.data.get(key) is not None:
                cure = (
                    "a subject who was not screened must not be photographed above 3 "
                    "flashes per second"
                )
                given.fault(
                    key,
                    "must be true: the operator confirmed it",
                    shown(given.data[key]),
                    cure,
                )
        return {**given.data, "operator": operator, "time": time}

    def _named_in_version_2(self, key: str) -> bool:
        """Whether a key of version 2 is given; version 1 keeps it as an attribute."""
        return self.version > 1 and self._has(key)

    def _mesh(self, path: Path | None) -> tuple[Scan | None, CleanMesh | None]:
        if path is None:
            return None, None
        try:
            scan = read_scan(path)
            surface = clean_mesh(scan.vertices, scan.faces)
        except InputError as error:
            self.faults += [
                Fault(f"{path} (mesh)", f.rule, f.found, f.cure or CURE)
                for f in error.faults
            ]
            return None, None
        if len(surface.faces) < max(2, 0.1 * len(scan.faces)):
            found = f"{len(surface.faces)} connected ones of {len(scan.faces)}"
            rule = "the triangles of a scan must share edges"
            self.faults.append(
                Fault(
                    f"{path} (mesh)",
                    rule,
                    found,
                    "export the scan as one connected surface",
                )
            )
            return scan, None
        if fault := scan_fault(f"{path} (mesh)", surface):
            self.unit_faults.append(fault)
        return scan, surface

    def _saved_crop(self) -> Crop | None:
        """The box in the file beside the landmarks, if there is one."""
        name = self.fields.get("landmarks", None)
        file = crop_path(Path(name)) if isinstance(name, str) and name else None
        if file is None or not os.path.lexists(self.folder / file):
            return None
        path = inside(
            self.folder, str(file), f"{self.fields.where}[landmarks]", self.faults
        )
        if path is None:
            return None
        self.files.append(path)
        noted = len(self.faults)
        data = read_json(path, self.faults)
        if len(self.faults) > noted:
            return None
        try:
            crop = parsed_crop(data, str(path))
        except InputError as error:
            self.faults += error.faults
            return None
        self.skipped.append(f"scan: the part outside the crop box of {file}")
        return crop

    def _cropped(
        self,
        path: Path,
        scan: Scan,
        surface: CleanMesh,
        landmarks: Mapping[str, NDArray[np.float64]],
    ) -> CleanMesh:
        """The part of the scan inside the crop, cleaned."""
        if self.crop is None:
            return surface
        if self.crop.reach_mm is not None and not landmarks:
            rule = "a crop around the landmarks needs landmarks"
            self.fields.fault("landmarks", rule, "none", "crop by a box instead")
            return surface
        keep = crop_faces(
            scan.vertices,
            scan.faces,
            self.crop,
            landmarks=np.array([*landmarks.values()]),
        )
        try:
            return clean_mesh(scan.vertices, scan.faces, keep=keep)
        except InputError:
            low, high = (
                " ".join(f"{x:.0f}" for x in corner)
                for corner in (np.min(scan.vertices, 0), np.max(scan.vertices, 0))
            )
            rule = "the crop must leave a part of the scan"
            found = f"{keep.sum()} of {len(keep)} triangles"
            self.faults.append(
                Fault(
                    f"{path} (mesh)",
                    rule,
                    found,
                    f"the scan reaches from {low} to {high} mm",
                )
            )
            return surface

    def _landmarks(
        self, scan: Scan | None, surface: CleanMesh | None
    ) -> dict[str, NDArray[np.float64]]:
        fields = self._object(
            "landmarks", "population analysis by landmarks is not possible"
        )
        if fields is None:
            return {}
        if not fields.data:
            self.skipped.append(
                "landmarks: none in the file; population analysis by landmarks is not possible"
            )
        if not fields.at_most(MAX_OBJECT_KEYS, "landmarks"):
            return {}
        points = {name: fields.array(name, (3,)) for name in fields.data}
        bad = {fault.where for fault in self.faults}
        sound = {name: p for name, p in points.items() if fields.place(name) not in bad}
        if scan is not None and surface is not None and sound and not self.unit_faults:
            off = landmark_faults(fields.where, sound, scan)
            if len(off) > max(2, len(sound) / 2):
                self.unit_faults += off
                return points
            off += [] if off else discarded_piece_faults(fields.where, sound, surface)
            off += [] if off else coincidence_faults(fields.where, sound)
            if off or self._face(fields.where, sound):
                self.faults += off
                return points
            order = order_fault(fields.where, sound)
            self.faults += (
                [order] if order else swapped_faults(fields.where, sound, surface)
            )
        return points

    def _face(self, where: str, points: Mapping[str, NDArray[np.float64]]) -> bool:
        """Whether the size of the face by its named points is a fault."""
        fault = face_fault(where, points)
        self.unit_faults += [] if fault is None else [fault]
        self.sized = fault is None and face_height(points) is not None
        return fault is not None

    def _joint_unit_fault(
        self,
        mesh_file: Path | None,
        scan: Scan,
        landmarks: Mapping[str, NDArray[np.float64]],
        regions: Mapping[str, NDArray[np.int64]],
    ) -> list[Fault]:
        """One fault for all parts in other units than mm; none if no units explain the lengths."""
        lengths = Lengths(scan, landmarks, _middles(scan, regions), self.dome)
        units = likely_units(lengths)
        if not units:
            return []
        dome = self.folder / str(self.fields.get("dome", ""))
        marks = self.folder / str(self.fields.get("landmarks", ""))
        files = {
            SCAN: f"{mesh_file} (mesh)",
            LANDMARKS: str(marks),
            CAMERAS: str(dome),
            LIGHTS: str(dome),
        }
        where = ", ".join(dict.fromkeys(files[part] for part in units))
        sizes = lengths.sizes
        said = [
            f"{words} {sizes[part]:.3g}"
            for part, words in SIZES.items()
            if part in sizes
        ]
        return [
            Fault(where, "all lengths must be in mm", ", ".join(said), unit_text(units))
        ]

    def _regions(
        self, scan: Scan | None, surface: CleanMesh | None
    ) -> dict[str, NDArray[np.int64]]:
        if self._has("regions") and not str(
            self.fields.get("regions")
        ).lower().endswith(".json"):
            path = self._path("regions")
            if path is not None and not path.is_file():
                self.fields.fault(
                    "regions",
                    "the file must exist",
                    short(str(path)),
                    "correct its name, or remove the key",
                )
            self.skipped.append(
                "regions: only vertex lists (JSON) can be read; there are no regions"
            )
            return {}
        fields = self._object(
            "regions", "no regions, no site of the probe can be placed"
        )
        if fields is None or scan is None:
            return {}
        if not fields.at_most(MAX_REGIONS, "regions"):
            return {}
        if WHOLE_SURFACE in fields.data:
            fields.fault(
                WHOLE_SURFACE,
                f"`{WHOLE_SURFACE}` is the name of the entire surface in every report",
                "a region of that name",
                "rename it",
            )
        found = {
            name: _vertices(fields, name, len(scan.vertices)) for name in fields.data
        }
        regions = {
            name: vertices for name, vertices in found.items() if vertices is not None
        }
        self.skipped += [
            f"region {name}: it has no vertices"
            for name, ids in regions.items()
            if not len(ids)
        ]
        if surface is not None and not (self.sized or self.unit_faults):
            self._face(fields.where, _middles(scan, regions))
        return regions

    def _dome(
        self, mesh_file: Path | None, surface: CleanMesh | None
    ) -> DomeRecord | None:
        fields = self._object("dome", "no photographs, no samples")
        dome = (
            None
            if fields is None
            else read_dome(
                self.folder,
                fields,
                self.version,
                calibrated=self._named_in_version_2("calibration"),
            )
        )
        if dome is not None and dome.white is None:
            self.skipped.append(
                "white: not in dome.json; intensities of the lights are taken as given"
            )
        if (
            fields is not None
            and dome is not None
            and surface is not None
            and not self.unit_faults
        ):
            bad = [fault.where for fault in self.faults]
            sound = not any(where.startswith(fields.where) for where in bad)
            unit = sound and unit_fault(
                fields.where, dome, f"{mesh_file} (mesh)", surface, sized=self.sized
            )
            self.unit_faults += (
                [unit]
                if unit
                else [
                    fault
                    for fault in device_faults(fields.where, dome, surface)
                    # locations that are themselves faulty
                    if not any(where.startswith(fault.where) for where in bad)
                ]
            )
        return dome

    def _probe(self) -> ProbeRecord | None:
        fields = self._object("contact", "no fibre profiles, no translucency")
        return None if fields is None else read_probe(self.folder, fields)

    def _require_sites(
        self, landmarks: Mapping[str, Any], regions: Mapping[str, NDArray[np.int64]]
    ) -> None:
        """Check that every site of the probe has a position: a landmark, or a non-empty
        region of its name.
        """
        for site in self.probe.sites if self.probe is not None else ():
            if site in landmarks or SITE_LANDMARK.get(site) in landmarks:
                continue
            if site in regions and not len(regions[site]):
                where = f"{self.folder / str(self.fields.get('regions'))}[{site}]"
                cure = "list its vertices, or remove the region"
                self.faults.append(
                    Fault(
                        where,
                        "a region that the probe measured must have vertices",
                        "none",
                        cure,
                    )
                )
            elif site not in regions:
                known = sorted({*regions, *landmarks, *SITE_LANDMARK} - {site})
                near = difflib.get_close_matches(site, known, n=1)
                meant = f" (did you mean {near[0]}?)" if near else ""
                self.skipped.append(
                    f"site {site}: no region or landmark of that name{meant}; its "
                    "position is unknown"
                )


def _middles(
    scan: Scan, regions: Mapping[str, NDArray[np.int64]]
) -> dict[str, NDArray[np.float64]]:
    """Centres of the regions."""
    return {
        name: scan.vertices[ids].mean(axis=0)
        for name, ids in regions.items()
        if len(ids)
    }


def _vertices(fields: Fields, name: str, count: int) -> NDArray[np.int64] | None:
    """The distinct vertex numbers of one region; None and a fault if they are not
    vertices of the scan.
    """
    parts = fields.get(name)
    if not isinstance(parts, list) or not all(isinstance(part, list) for part in parts):
        fields.fault(name, "must be lists of vertex numbers, [[..]]", shown(parts))
        return None
    numbers = [number for part in parts for number in part]
    if wrong := [n for n in numbers if not isinstance(n, int) or isinstance(n, bool)]:
        fields.fault(name, "must be lists of vertex numbers, [[..]]", shown(wrong[0]))
        return None
    if numbers and not 0 <= min(numbers) <= max(numbers) < count:
        rule = f"vertex numbers must be below {count}, the vertices of the scan"
        fields.fault(name, rule, f"{shown(min(numbers))} to {shown(max(numbers))}")
        return None
    return np.unique(np.array(numbers, np.int64))

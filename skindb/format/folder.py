"""Reading a capture folder (docs/capture_format.md, versions 1 and 2) as frozen
records, with all faults at once.
"""

import difflib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skindb.errors import Fault, InputError, attempt, few_names
from skindb.files import Attributes, Json
from skindb.format.contact_probe import ProbeRecord, read_probe
from skindb.format.dome import DomeRecord, read_dome, unread_frames
from skindb.format.fields import (
    CURE,
    IDENTIFIER,
    MAX_MAGNITUDE,
    NAME,
    Fields,
    is_number,
    read_json,
    short,
    shown,
    zoned_time,
)
from skindb.format.frames import decoding_faults, inside
from skindb.format.scan_checks import (
    SITE_LANDMARK,
    coincidence_faults,
    crop_path,
    device_faults,
    dome_unit_faults,
    face_faults,
    face_height,
    landmark_faults,
    order_faults,
    parsed_crop,
    scan_faults,
    swapped_faults,
)
from skindb.geometry.clean import CleanMesh, clean_mesh
from skindb.geometry.scan import Crop, Scan, crop_faces, read_scan
from skindb.limits import MAX_FRAMES, MAX_OBJECT_KEYS, MAX_REGIONS, MAX_VISIT
from skindb.parameters import SCAN_ERROR_DEGREES
from skindb.schema.cohort import imitates_column, take_name
from skindb.schema.consent import SCOPES
from skindb.types import Float64, Index

Point = Float64  # (3,) mm
FORMAT = "skindb-capture"
VERSIONS = (1, 2)
OVERRIDE = ("screened", "consented", "eyes_closed")  # what the operator confirms
# degrees
MIN_SCAN_ERROR = 0.1
MAX_SCAN_ERROR = 90.0
WHOLE_SURFACE = "all"  # name of the entire surface in reports by region
_NONE = np.zeros(0, np.int64)
NO_SCAN = Scan(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
NO_SURFACE = CleanMesh(NO_SCAN.vertices, NO_SCAN.faces, _NONE, _NONE, {}, {})
SIMULATED = ("virtual", "seed", "rehearsal")  # attributes of virtual captures


@dataclass(frozen=True)
class Capture:
    """Content of a capture folder; frames are decoded later."""

    folder: Path
    subject: str
    session: str
    condition: str
    visit: int | None  # None if capture.json states none
    repeat: int
    traits: Attributes
    consent_scope: tuple[str, ...]
    consent_reference: str
    # name of the calibration in the database that applied; empty: the values of
    # dome.json
    calibration: str
    scan_error: float  # RMS angle of the scan's normals to the true ones [degree]
    # confirmation of flashes above the limit for photosensitive seizures; may be empty
    override: Attributes
    mesh_file: Path | None
    # without vertices if there is no scan: ingest makes them from the photographs
    scan: Scan
    surface: CleanMesh
    landmarks: Mapping[str, Point]
    regions: Mapping[str, Index]  # vertices of the scan
    dome: DomeRecord | None
    probe: ProbeRecord | None
    json_files: tuple[Path, ...]
    attributes: Attributes  # keys that the format does not define
    # those to report, with the key that may have been intended
    unknown_keys: tuple[str, ...]
    skipped: tuple[str, ...]  # missing parts, and the results that depend on them
    crop: Crop | None = None  # limits of the scan
    # version of the calibration that provides its lights
    calibrated_by: Attributes | None = None

    @property
    def has_scan(self) -> bool:
        """Whether the surface was scanned; otherwise ingest estimates it."""
        return self.mesh_file is not None

    @property
    def take(self) -> str:
        """Name of the take, in the first visit if none is stated."""
        return take_name(self.subject, self.condition, self.visit or 1, self.repeat)


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
    data = None
    if inside(folder, file.name, str(file), faults):
        data = read_json(file, faults)
    if data is None:
        raise InputError(faults)
    fields = Fields(data, str(file), faults)
    # require a known format and version; nothing else can be checked without them
    for key, choices in (("format", (FORMAT,)), ("version", VERSIONS)):
        value = fields.get(key)
        if value is not None and (value not in choices or isinstance(value, bool)):
            fields.fault(
                key,
                f"must be {' or '.join(map(json.dumps, choices))}, which this skindb reads",
                shown(value),
                "update skindb, or write this version",
            )
            raise InputError(fields.faults)
    reader = _Reader(folder, fields, crop)
    capture = reader.capture()
    if faults or capture is None:
        faults += decoding_faults(reader.frame_files(), faults)
        raise InputError(faults)
    return capture


def record_faults(record: Attributes) -> list[Fault]:
    """Faults that `read_capture` would report for the values of `capture.json` that are
    not file names.
    """
    fields = Fields(dict(record), "capture.json", [])
    _Reader(Path(), fields, None).person()
    return fields.faults


class _Reader:
    """The files that `capture.json` names, one after the other."""

    def __init__(self, folder: Path, fields: Fields, crop: Crop | None) -> None:
        self.folder = folder
        self.fields = fields
        self.faults = fields.faults
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
        mesh_file = self._path("mesh") if fields.has("mesh") else None
        self.mesh_place = f"{mesh_file} (mesh)"
        scan, surface = self._mesh(mesh_file)
        landmarks = self._landmarks(surface)
        regions = self._regions(scan, surface)
        self.dome = self._dome(surface)
        probe = self._object("contact", "no fibre profiles, no translucency")
        if probe is not None:
            self.probe = read_probe(self.folder, probe)
        self._require_sites(landmarks, regions)
        self.faults += self.unit_faults
        if not fields.has("mesh"):
            self._require_one_camera()
            scan, surface = NO_SCAN, NO_SURFACE
        if scan is None or surface is None:
            return None
        self.crop = self.crop or self._saved_crop()
        surface = self._cropped(scan, surface, landmarks)
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

    def person(self) -> Json:
        """Subject, session and consent: the values of `capture.json` that are not file names."""
        fields = self.fields
        record: Json = {
            "subject": fields.text("subject", rule=NAME),
            "condition": fields.text("condition", rule=NAME, default="normal"),
            "session": fields.text("session"),
            "traits": self._traits(),
        }
        for key, default in (("visit", None), ("repeat", 1)):
            record[key] = default
            if self._has_in_version_2(key):
                record[key] = fields.integer(key, minimum=1, maximum=MAX_VISIT)
        if record["visit"] is None and record["repeat"] != 1:
            rule = "a repeat belongs to a visit"
            fields.fault("repeat", rule, shown(record["repeat"]), "state the visit too")
        if record["session"] and zoned_time(record["session"]) is None:
            fields.fault(
                "session",
                "must be an ISO 8601 time with its zone",
                shown(record["session"]),
                "write it like 2005-01-10T09:00:00+01:00",
            )
        record["consent_scope"], record["consent_reference"] = self._consent()
        record["calibration"] = ""
        if self._has_in_version_2("calibration"):
            record["calibration"] = fields.text("calibration", rule=NAME)
        record["scan_error"] = SCAN_ERROR_DEGREES
        if self._has_in_version_2("scan_error"):
            record["scan_error"] = fields.number(
                "scan_error", minimum=MIN_SCAN_ERROR, maximum=MAX_SCAN_ERROR
            )
        return record | {"override": self._override()}

    def frame_files(self) -> Iterator[Path]:
        """All frames of the dome and of the probe, as far as these could be read."""
        if self.dome is not None and self.dome.frame_count <= MAX_FRAMES:
            yield from self.dome.frame_files("frames", "dark", "white")
        if self.probe is not None and self.probe.frames:
            yield from self.probe.frame_files()

    def _path(self, key: str) -> Path | None:
        name = self.fields.text(key)
        place = self.fields.place(key)
        return inside(self.folder, name, place, self.faults) if name else None

    def _object(self, key: str, missing: str) -> Fields | None:
        """The JSON object of an optional file; a line in `skipped` if capture.json does
        not name the file.
        """
        if not self.fields.has(key):
            self.skipped.append(f"{key}: not in capture.json; {missing}")
            return None
        path = self._path(key)
        if path is None:
            return None
        self.files.append(path)
        data = read_json(path, self.faults)
        return None if data is None else Fields(data, str(path), self.faults)

    def _traits(self) -> Json:
        traits = self.fields.object("traits", {})
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
                if name == "age":
                    self.skipped.append(
                        f"age: {shown(value)} is no number of years; write, for example, 31"
                    )
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
        if self.fields.get("consent") is None:
            return (), ""
        consent = self.fields.object("consent")
        scope = consent.names("scope", minimum=0, maximum=len(SCOPES))
        if unknown := [name for name in scope if name not in SCOPES]:
            consent.fault(
                "scope", f"must be from {', '.join(SCOPES)}", short(", ".join(unknown))
            )
        return scope, consent.text("reference")

    def _override(self) -> Json:
        """The operator's confirmation of flashes above the limit, which is valid only
        if it is complete.
        """
        if not self._has_in_version_2("override"):
            return {}
        override = self.fields.object("override")
        operator = override.text("operator", rule=IDENTIFIER)
        time = override.text("time", default="")
        for key in OVERRIDE:
            value = override.get(key)
            if value is not None and value is not True:
                override.fault(
                    key,
                    "must be true: the operator confirmed it",
                    shown(value),
                    "a subject who was not screened must not be photographed above 3 "
                    "flashes per second",
                )
        return {**override.data, "operator": operator, "time": time}

    def _has_in_version_2(self, key: str) -> bool:
        """Whether a key of version 2 is given; version 1 keeps it as an attribute."""
        return self.version > 1 and self.fields.has(key)

    def _mesh(self, path: Path | None) -> tuple[Scan | None, CleanMesh | None]:
        if path is None:
            return None, None
        try:
            scan = read_scan(path)
            surface = clean_mesh(scan.vertices, scan.faces)
        except InputError as error:
            self.faults += [
                Fault(self.mesh_place, fault.rule, fault.found, fault.cure or CURE)
                for fault in error.faults
            ]
            return None, None
        if len(surface.faces) < max(2, 0.1 * len(scan.faces)):
            self.faults.append(
                Fault(
                    self.mesh_place,
                    "the triangles of a scan must share edges",
                    f"{len(surface.faces)} connected ones of {len(scan.faces)}",
                    "export the scan as one connected surface",
                )
            )
            return scan, None
        self.unit_faults += scan_faults(self.mesh_place, surface)
        return scan, surface

    def _require_one_camera(self) -> None:
        """Without a scan, the surface is estimated from the photographs of one camera."""
        cameras = 0 if self.dome is None else len(self.dome.cameras)
        if cameras != 1 and not self.faults:
            self.fields.fault(
                "mesh",
                "a capture needs a scan, unless one camera photographed the face",
                f"no scan, {cameras} cameras",
                "scan the face, or reconstruct it from the photographs of all cameras with "
                "a program for photogrammetry such as COLMAP or Meshroom; or keep one camera",
            )
        self.skipped.append(
            "mesh: not in capture.json; the surface is estimated from the shading, and its "
            "normals are no prior"
        )

    def _saved_crop(self) -> Crop | None:
        """The box in the file beside the landmarks, if there is one."""
        name = self.fields.get("landmarks", None)
        if not isinstance(name, str) or not name:
            return None
        file = crop_path(Path(name))
        if not os.path.lexists(self.folder / file):
            return None
        place = self.fields.place("landmarks")
        path = inside(self.folder, str(file), place, self.faults)
        if path is None:
            return None
        self.files.append(path)
        earlier = len(self.faults)
        data = read_json(path, self.faults)
        if len(self.faults) > earlier:
            return None
        crop = attempt(self.faults, lambda: parsed_crop(data, str(path)))
        if crop is not None:
            self.skipped.append(f"scan: the part outside the crop box of {file}")
        return crop

    def _cropped(
        self, scan: Scan, surface: CleanMesh, landmarks: Mapping[str, Point]
    ) -> CleanMesh:
        """The part of the scan inside the crop, cleaned."""
        if self.crop is None or not len(scan.vertices):
            return surface
        if self.crop.reach_mm is not None and not landmarks:
            rule = "a crop around the landmarks needs landmarks"
            self.fields.fault("landmarks", rule, "none", "crop by a box instead")
            return surface
        points = np.array([*landmarks.values()])
        keep = crop_faces(scan.vertices, scan.faces, self.crop, landmarks=points)
        try:
            return clean_mesh(scan.vertices, scan.faces, keep=keep)
        except InputError:
            low, high = (
                " ".join(f"{x:.0f}" for x in corner)
                for corner in (np.min(scan.vertices, 0), np.max(scan.vertices, 0))
            )
            rule = "the crop must leave a part of the scan"
            self.faults.append(
                Fault(
                    self.mesh_place,
                    rule,
                    f"{keep.sum()} of {len(keep)} triangles",
                    f"the scan reaches from {low} to {high} mm",
                )
            )
            return surface

    def _landmarks(self, surface: CleanMesh | None) -> dict[str, Point]:
        missing = "population analysis by landmarks is not possible"
        fields = self._object("landmarks", missing)
        if fields is None:
            return {}
        if not fields.data:
            self.skipped.append(f"landmarks: none in the file; {missing}")
        if not fields.at_most(MAX_OBJECT_KEYS, "landmarks"):
            return {}
        points = {name: fields.array(name, (3,)) for name in fields.data}
        faulty = {fault.where for fault in self.faults}
        sound = {
            name: point
            for name, point in points.items()
            if fields.place(name) not in faulty
        }
        if surface is not None and sound and not self.unit_faults:
            self._check_landmarks(fields.where, sound, surface)
        return points

    def _check_landmarks(
        self, where: str, points: Mapping[str, Point], surface: CleanMesh
    ) -> None:
        """Record the first kind of fault that landmarks have."""
        distant = landmark_faults(where, points, surface)
        if len(distant) > max(2, len(points) / 2):
            self.unit_faults += face_faults(where, points, on_scan=False) or distant
            return
        faults = distant or coincidence_faults(where, points)
        if not faults and not self._check_size(where, points):
            faults = order_faults(where, points) or swapped_faults(
                where, points, surface
            )
        self.faults += faults

    def _check_size(self, where: str, points: Mapping[str, Point]) -> list[Fault]:
        """Faults, which are also recorded, of the size of the face by its named points."""
        faults = face_faults(where, points)
        self.unit_faults += faults
        self.sized = not faults and face_height(points) is not None
        return faults

    def _regions(
        self, scan: Scan | None, surface: CleanMesh | None
    ) -> dict[str, Index]:
        name = self.fields.get("regions", None)
        if name is not None and not str(name).lower().endswith(".json"):
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
        missing = "no regions, no site of the probe can be placed"
        fields = self._object("regions", missing)
        if fields is None or scan is None or not fields.at_most(MAX_REGIONS, "regions"):
            return {}
        if WHOLE_SURFACE in fields.data:
            fields.fault(
                WHOLE_SURFACE,
                f"`{WHOLE_SURFACE}` is the name of the entire surface in every report",
                "a region of that name",
                "rename it",
            )
        regions = {}
        for name in fields.data:
            vertices = _vertices(fields, name, len(scan.vertices))
            if vertices is not None:
                regions[name] = vertices
                if not len(vertices):
                    self.skipped.append(f"region {name}: it has no vertices")
        if surface is not None and not (self.sized or self.unit_faults):
            middles = {
                name: scan.vertices[ids].mean(axis=0)
                for name, ids in regions.items()
                if len(ids)
            }
            self._check_size(fields.where, middles)
        return regions

    def _dome(self, surface: CleanMesh | None) -> DomeRecord | None:
        fields = self._object("dome", "no photographs, no samples")
        if fields is None:
            return None
        calibrated = self._has_in_version_2("calibration")
        dome = read_dome(self.folder, fields, self.version, calibrated=calibrated)
        if dome.white is None:
            meaning = (
                "R_d is relative to an unknown factor per channel"
                if dome.relative
                else "intensities of the lights are taken as given"
            )
            self.skipped.append(f"white: not in dome.json; {meaning}")
        if not self.faults and (unread := unread_frames(dome)):
            self.skipped.append(
                f"frames: not read, as dome.json lacks their light, camera or exposure: "
                f"{few_names(unread, 1)}"
            )
        if surface is None or self.unit_faults:
            return dome
        file = fields.where
        places = [fault.where for fault in self.faults]
        if not any(place.startswith(file) for place in places):
            self.unit_faults += dome_unit_faults(
                file, dome, self.mesh_place, surface, sized=self.sized
            )
        if not self.unit_faults:
            self.unit_faults += [
                fault
                for fault in device_faults(file, dome, surface)
                # locations that are themselves faulty
                if not any(place.startswith(fault.where) for place in places)
            ]
        return dome

    def _require_sites(
        self, landmarks: Attributes, regions: Mapping[str, Index]
    ) -> None:
        """Check that every site of the probe has a position: a landmark, or a non-empty
        region of its name.
        """
        for site in self.probe.sites if self.probe is not None else ():
            if site in landmarks or SITE_LANDMARK.get(site) in landmarks:
                continue
            if site not in regions:
                names = sorted({*regions, *landmarks, *SITE_LANDMARK} - {site})
                near = difflib.get_close_matches(site, names, n=1)
                meant = f" (did you mean {near[0]}?)" if near else ""
                self.skipped.append(
                    f"site {site}: no region or landmark of that name{meant}; its "
                    "position is unknown"
                )
            elif not len(regions[site]):
                self.faults.append(
                    Fault(
                        f"{self.folder / str(self.fields.get('regions'))}[{site}]",
                        "a region that the probe measured must have vertices",
                        "none",
                        "list its vertices, or remove the region",
                    )
                )


def _vertices(fields: Fields, name: str, count: int) -> Index | None:
    """The distinct vertex numbers of one region; None and a fault if they are not
    vertices of the scan.
    """
    rule = "must be lists of vertex numbers, [[..]]"
    parts = fields.get(name)
    if not isinstance(parts, list) or not all(isinstance(part, list) for part in parts):
        fields.fault(name, rule, shown(parts))
        return None
    numbers = [number for part in parts for number in part]
    for number in numbers:
        if not isinstance(number, int) or isinstance(number, bool):
            fields.fault(name, rule, shown(number))
            return None
    if numbers and not 0 <= min(numbers) <= max(numbers) < count:
        rule = f"vertex numbers must be below {count}, the vertices of the scan"
        fields.fault(name, rule, f"{shown(min(numbers))} to {shown(max(numbers))}")
        return None
    return np.unique(np.array(numbers, int))

"""Simulation of virtual takes: a capture folder for each, a file with the true parameters, and
the comparison of fitted with true parameters.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import require
from skindb.files import Json, make_private, private_file
from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import dipole_s
from skindb.parameters import CONDITIONS, SimulationParameters
from skindb.reflectance.dictionary import (
    Dictionary,
    abc_parameters,
    convolve_disc,
    embedded_dictionary,
)
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.tables import directional_albedo
from skindb.render.scene import Surface
from skindb.schema import FitStatus, variables
from skindb.types import Array, Float64, Mask, Progress, lengths
from skindb.virtual.dome import (
    CENTRE,
    DARK,
    DISC_RADIUS,
    EXPOSURES,
    FRAMES,
    LEAK,
    LIGHT_RADIUS,
    SECONDS,
    TARGET_HALF_SIZE,
    TARGET_NORMAL,
    TARGET_REFLECTANCE,
    WHITE,
    Dome,
    DomeCamera,
    DomeLight,
    Sensor,
    build_dome,
    frontal_camera,
    photograph,
)
from skindb.virtual.head import Head, parametric_head
from skindb.virtual.person import Person, default_people, face_shape
from skindb.virtual.probe import ProbeTruth, write_probe
from skindb.virtual.skin import MATERIALS, Skin, materials_of, skin_of, smooth_noise

# mm along the normal of the scan within which the true surface is searched
SEARCH = 5.0
# mm
TRUE_SPACING = 1.5
SCAN_SPACING = 3.6
SCAN_NOISE = 0.08  # mm each, smooth and white
DEVICE_SEED = 2005
SITE_TRUTH = (  # fields of a site in the file of the truth
    "position",
    "diffuse_reflectance",
    "sigma_tr",
    "sigma_a",
    "sigma_s_prime",
)
SCAN_REGIONS = ("forehead", "nose", "cheek", "lips", "chin", "neck", "beard")


def session_time(person: Person) -> datetime:
    """A fixed time that depends only on the person, the condition and the visit."""
    days = person.seed % 365 + 28 * ((person.visit or 1) - 1)
    minutes = 40 * CONDITIONS.index(person.condition)
    return datetime(2005, 1, 10, 9, 0, tzinfo=UTC) + timedelta(
        days=days, minutes=minutes
    )


def capture_record(person: Person, *, contact: bool, landmarks: bool) -> Json:
    """capture.json."""
    traits = {
        "age": person.age,
        "gender": person.gender,
        "ancestry": person.ancestry,
        "beard_density": person.beard_density,
        "freckles": person.freckles,
    }
    record = {
        "format": "skindb-capture",
        "version": 2 if person.visit else 1,
        **({"visit": person.visit} if person.visit else {}),
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


def dome_record(dome: Dome, sensor: Sensor, start: datetime) -> Json:
    """Content of dome/dome.json, without the intensities of the lights, which the white
    target determines.
    """
    cameras = [
        {
            "id": c.name,
            "width": c.width,
            "height": c.height,
            "K": c.K.tolist(),
            "R": c.R.tolist(),
            "t": c.t.tolist(),
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
        | _polariser(c)
        for c in dome.cameras
    ]
    lights = [
        {
            "id": light.name,
            "position": light.position.tolist(),
            "disc_radius": light.disc_radius,
            "intensity": None,  # determined by the white target
            "axis": light.axis.tolist(),
            "falloff": light.falloff,
        }
        | _polariser(light)
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


def _polariser(device: DomeCamera | DomeLight) -> Json:
    """Keys of a light or camera with a polariser."""
    if device.polariser is None:
        return {}
    return {"polariser": device.polariser, "leak": LEAK}


def _sequence(dome: Dome, start: datetime) -> list[Json]:
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


def simulate_take(
    out: Path,
    person: Person,
    dome: Dome,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    eta: float = 1.3,
    subsurface: bool = False,
    sensor: Sensor | None = None,
    spacing_mm: float = TRUE_SPACING,
) -> None:
    """Photograph and probe `person`: a folder of CAPTURE_FORMAT version 1 at `out`, the
    truth at `<out>.truth.npz`.

    Parameters
    ----------
    out
        Folder to create; it must be absent or empty.
    person, dome
        The subject and the device.
    rng
        Noise of this take; shape and skin depend on the person alone.
    progress
        Called with the stage, the steps done and the total number of steps.
    eta
        Index of refraction of the skin.
    subsurface
        Transport diffuse light through the skin by the dipole instead of reflecting it
        where it enters.
    sensor
        Cameras of the dome.
    spacing_mm
        Edge length of the true surface; that of the scan is about twice as large.
    """
    _require_empty(out)
    total = len(dome.cameras) + 3
    steps = count(1)

    def report() -> None:
        if progress is not None:
            progress(f"simulate {person.take}", next(steps), total)

    geometry_rng, frame_rng, probe_rng = rng.spawn(3)
    names = materials_of(person)
    dictionary, albedo = _materials(names)
    head, scan = _heads(person, spacing_mm, geometry_rng)
    skin = skin_of(head, person, material_albedo=albedo, eta=eta)
    report()
    make_private(out / "dome")
    _write_scan(out, scan, rng=geometry_rng)
    probe = None
    if skin.sites:
        for site in skin.sites:
            make_private(out / "contact" / site.name)
        probe = write_probe(out, skin.sites, eta=eta, rng=probe_rng)
    report()
    device_rng = np.random.default_rng(DEVICE_SEED)
    sensor = sensor or Sensor()
    surface = _surface(head, skin, dictionary, eta)
    photograph(
        out,
        surface,
        dome,
        sensor=sensor,
        device_rng=device_rng,
        rng=frame_rng,
        subsurface=subsurface,
        step=report,
    )
    _dump(out / "dome" / "dome.json", dome_record(dome, sensor, session_time(person)))
    _write_truth(out, head, skin, names, probe, dome, eta=eta, subsurface=subsurface)
    # written last, as a folder without it is incomplete
    _dump(
        out / "capture.json",
        capture_record(
            person, contact=probe is not None, landmarks=bool(scan.landmarks)
        ),
    )
    report()


def _require_empty(out: Path) -> None:
    require(
        not out.exists() or (out.is_dir() and not any(out.iterdir())),
        str(out),
        "a new capture needs an absent or empty folder",
        "existing files",
        "choose another folder",
    )


@cache
def _materials(names: tuple[str, ...] = MATERIALS) -> tuple[Dictionary, Float64]:
    """Materials of the true surface for the dome's lights, and their directional albedo
    at normal incidence.
    """
    embedded = embedded_dictionary()
    index = [embedded.names.index(name) for name in names]
    table = np.ascontiguousarray(embedded.table[..., index])
    # the tables are convolved with the disc of the lights: one ray per pixel and light is enough
    disc = convolve_disc(
        replace(embedded, names=names, table=table, exact=0),
        DISC_RADIUS / LIGHT_RADIUS,
    )
    return disc, directional_albedo(table, np.ones(1))[0]


def _heads(
    person: Person, spacing_mm: float, rng: np.random.Generator
) -> tuple[Head, Head]:
    """The true head, and a coarser sampling of it for the scan."""
    shape = face_shape(person)
    coarse = max(SCAN_SPACING, 1.8 * spacing_mm)
    scan = parametric_head(
        shape, spacing_mm=coarse, jitter=0.25, seed=int(rng.integers(2**31))
    )
    return parametric_head(shape, spacing_mm=spacing_mm), scan


def _surface(head: Head, skin: Skin, dictionary: Dictionary, eta: float) -> Surface:
    s, _ = dipole_s(skin.diffuse, eta=eta)
    return Surface(
        head.vertices,
        head.faces,
        head.normals,
        skin.diffuse,
        skin.weights,
        Mixture(dictionary.table, disc_angular_radius=dictionary.disc_angular_radius),
        s=s,
        sigma_tr=skin.sigma_tr,
        eta=eta,
    )


def _write_scan(out: Path, scan: Head, *, rng: np.random.Generator) -> None:
    """Write the mesh with the noise of a scanner, landmarks with the errors of clicks,
    and regions as vertex lists.
    """
    white = rng.standard_normal(len(scan.vertices))
    noise = SCAN_NOISE * (smooth_noise(scan.vertices, 12.0, rng=rng) + white)
    vertices = scan.vertices + noise[:, None] * scan.normals
    trimesh.Trimesh(vertices, scan.faces, process=False).export(
        private_file(out / "scan.ply")
    )
    if scan.landmarks:
        clicked = {
            name: (p + rng.normal(0, 0.2, 3)).round(3).tolist()
            for name, p in scan.landmarks.items()
        }
        _dump(out / "landmarks.json", clicked)
    regions = {
        name: [np.flatnonzero(scan.region(name)).tolist()]
        for name in SCAN_REGIONS
        if scan.region(name).any()
    }
    _dump(out / "regions.json", regions)


def _write_truth(
    out: Path,
    head: Head,
    skin: Skin,
    names: tuple[str, ...],
    probe: ProbeTruth | None,
    dome: Dome,
    *,
    eta: float,
    subsurface: bool,
) -> None:
    """Write the true parameters of the take at the vertices of the true surface."""
    touched: Json = {}
    if probe is not None:
        touched = {"probe_distance": probe.distance, "probe_profile": probe.profile}
    for name in SITE_TRUTH:
        values = [getattr(site, name) for site in skin.sites]
        touched[f"site_{name}"] = np.array(values).reshape(-1, 3)
    abc = abc_parameters()  # lobes are not in it, and reflect nothing evenly
    lambertian = [np.mean(abc[x][:3]) if x in abc else 0.0 for x in names]
    np.savez(
        private_file(out.with_name(out.name + ".truth.npz")),
        vertices=head.vertices,
        faces=head.faces.astype(np.int32),
        normals=head.normals,
        diffuse_reflectance=skin.diffuse,
        surface_weights=skin.weights,
        surface_names=np.array(names),
        surface_bases=skin.bases,
        gloss_causes=np.array([*skin.gloss]),
        gloss_factors=np.array([*skin.gloss.values()]),
        # includes the Lambertian albedo of the materials, which no fit can distinguish from R_d
        surface_lambertian=skin.weights @ np.array(lambertian),
        sigma_tr=skin.sigma_tr,
        region_names=np.array([*head.membership]),
        region_membership=np.stack([*head.membership.values()], 1).astype(np.float32),
        landmark_names=np.array([*head.landmarks]),
        landmark_position=np.array([*head.landmarks.values()]).reshape(-1, 3),
        site_names=np.array([site.name for site in skin.sites]),
        light_intensity=np.array([light.intensity for light in dome.lights]),
        eta=np.array(eta),
        subsurface=np.array(subsurface),
        **touched,
    )


def _dump(path: Path, record: Any) -> None:
    private_file(path).write_text(json.dumps(record, indent=1), encoding="utf-8")


def simulate_takes(
    out: Path,
    parameters: SimulationParameters | None = None,
    *,
    takes: int | Sequence[int] = 8,
    people: Sequence[Person] | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write `<out>/<take>` and `<out>/<take>.truth.npz` for virtual people, all
    photographed by one dome; each take is independent of the others.

    Parameters
    ----------
    out
        Folder of the captures; a take's own folder must be absent or empty.
    parameters
        The dome, its frames and the noise; default `SimulationParameters()`.
    takes
        Number of people, or their indices.
    people
        The people to choose from; default `default_people`.
    progress
        Called with the stage, the steps done and the total number of steps.
    """
    settings = parameters or SimulationParameters()
    dome = build_dome(
        settings.lights,
        settings.cameras,
        width=settings.width,
        height=settings.height,
        polarised=settings.polarised,
        rng=np.random.default_rng(DEVICE_SEED),
    )
    folders = []
    everybody = default_people() if people is None else people
    for i in range(len(everybody))[:takes] if isinstance(takes, int) else takes:
        person = replace(everybody[i], bases=settings.bases)
        folders.append(out / person.take)
        simulate_take(
            folders[-1],
            person,
            dome,
            subsurface=settings.subsurface,
            rng=np.random.default_rng([settings.seed, i]),
            progress=progress,
        )
    return folders


@dataclass(frozen=True)
class Recovery:
    """Errors of one fitted take; those per surfel are NaN where the true surface was not found."""

    normal_angle: Array  # (surfel,) degrees
    diffuse_error: Array  # (surfel, channel) relative
    true_diffuse: Array  # (surfel, channel)
    fitted: Mask  # (surfel,)
    sigma_tr_error: Mapping[str, Array]  # site -> (channel,) relative, signed

    def summary(self) -> dict[str, object]:
        """Medians and 95 % quantiles over fitted surfels."""
        angle = self.normal_angle[self.fitted]
        error = np.abs(self.diffuse_error[self.fitted])
        sites = {
            site: np.round(100 * value, 1).tolist()
            for site, value in self.sigma_tr_error.items()
        }
        return {
            "normal_median_deg": round(float(np.nanmedian(angle)), 2),
            "normal_95_deg": round(float(np.nanquantile(angle, 0.95)), 2),
            "diffuse_median_percent": np.round(
                100 * np.nanmedian(error, axis=0), 1
            ).tolist(),
            "diffuse_bias_percent": np.round(
                100 * np.nanmedian(self.diffuse_error[self.fitted], axis=0), 1
            ).tolist(),
            "sigma_tr_percent": sites,
        }


def recovered_against_true(model: xr.DataTree, truth: Mapping[str, Array]) -> Recovery:
    """Compare a fitted model with the truth at the foot point of every surfel on the true surface.

    Parameters
    ----------
    model
        Version of kind "model".
    truth
        Arrays vertices (v, 3) mm, faces (f, 3), normals (v, 3), diffuse_reflectance (v,
        3), and where the probe touched site_names (s,) and site_sigma_tr (s, 3) mm^-1.
    """
    fitted = model["fitted"].to_dataset()
    face, corner = foot_points(fitted, truth)
    corners = truth["faces"][np.maximum(face, 0)]
    normal = at_foot_points(truth["normals"][corners], corner)
    length = lengths(normal)[..., None]
    normal = np.divide(
        normal, length, out=np.full_like(normal, np.nan), where=length > 0
    )
    diffuse = np.where(
        (face >= 0)[:, None],
        at_foot_points(truth["diffuse_reflectance"][corners], corner),
        np.nan,
    )
    cosine = np.clip((normal * fitted[variables.SHADING_NORMAL].values).sum(1), -1, 1)
    return Recovery(
        np.where(face >= 0, np.degrees(np.arccos(cosine)), np.nan),
        fitted[variables.DIFFUSE_REFLECTANCE].values / diffuse - 1,
        diffuse,
        fitted[variables.FIT_STATUS].values == FitStatus.FITTED,
        _sites(model, truth),
    )


def foot_points(
    fitted: xr.Dataset, truth: Mapping[str, Array]
) -> tuple[NDArray[np.integer], Array]:
    """Nearest points of the true surface along the normals of the surfels: face (n,), -1
    where there is none, and barycentric coordinates (n, 3).
    """
    position, normal = (
        fitted[name].values.astype(float)
        for name in (variables.SURFEL_POSITION, variables.SURFEL_NORMAL)
    )
    scene = RayScene(truth["vertices"], truth["faces"].astype(int))
    face, corner, distance = scene.first_hit(position + SEARCH * normal, -normal)
    return np.where(distance <= 2 * SEARCH, face, -1), corner


def at_foot_points(values: Array, corner: Array) -> Array:
    """Values (n, 3, c) of the corners, interpolated (n, c)."""
    return np.einsum("nkc,nk->nc", values.astype(float), corner)


def _sites(model: xr.DataTree, truth: Mapping[str, Array]) -> dict[str, Array]:
    if "translucency" not in model.children or "site_names" not in truth:
        return {}
    fitted = model["translucency"].dataset[variables.SITE_SIGMA_TR]
    true = dict(zip(map(str, truth["site_names"]), truth["site_sigma_tr"], strict=True))
    return {
        str(s): fitted.sel(site=s).values / true[str(s)] - 1
        for s in fitted["site"].values
        if str(s) in true
    }

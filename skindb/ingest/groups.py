"""The labelled groups of a version of kind "capture"."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from skindb.calibration.radiance import Image
from skindb.format.contact_probe import ProbeRecord
from skindb.format.dome import DomeRecord, SequenceRecord
from skindb.format.folder import Capture
from skindb.geometry.atlas import distortion
from skindb.ingest.consistency import Calibration
from skindb.ingest.lumitexels import Lumitexels
from skindb.ingest.probe_profiles import Profiles
from skindb.ingest.surfels import SurfelSet, blended_lobes, transferred_landmarks
from skindb.parameters import SCAN_ERROR_DEGREES
from skindb.schema import dataset
from skindb.types import Float64, Half

CHANNELS = {"channel": ["R", "G", "B"]}  # coordinate
# of the spool
COUNTS = ("sample_count", "saturated_count", "dark_count")


def surfel_group(
    surfels: SurfelSet,
    dome: DomeRecord | None = None,
    light_fraction: Half | None = None,
    camera_fraction: Half | None = None,
    *,
    scan_error: float = SCAN_ERROR_DEGREES,
) -> xr.Dataset:
    """Group "surfels", with the error of the scan's normals [degree]; without a dome it
    has no visibility.
    """
    variables = {
        "surfel_position": surfels.position,
        "surfel_normal": surfels.normal,
        "surfel_area": surfels.area,
        "surfel_uv": surfels.uv,
        "scan_normal_error": scan_error,
    }
    coords = {}
    if surfels.region_names:
        variables["region_mask"] = surfels.region.astype(np.int8)
        coords["region"] = list(surfels.region_names)
    if dome is not None and dome.lobes:
        regions = dict(zip(surfels.region_names, surfels.region.T, strict=True))
        strength = blended_lobes(surfels.position, regions, dome.lobes)
        variables["lobe_strength_applied"] = strength
    if dome is not None and light_fraction is not None:
        variables |= {
            "light_visible_fraction": light_fraction,
            "camera_visible_fraction": camera_fraction,
        }
        coords |= _dome_names(dome)
    return dataset(variables, coords=coords)


def mesh_group(capture: Capture, surfels: SurfelSet) -> xr.Dataset:
    """Group "mesh"."""
    variables: dict[str, Any] = {"triangle": surfels.faces}
    coords = {}
    if capture.landmarks:
        position, distance = transferred_landmarks(capture, surfels)
        variables |= {
            "landmark_position": position,
            "landmark_surface_distance": distance,
        }
        coords["landmark"] = [*capture.landmarks]
    return dataset(variables, coords=coords)


def atlas_group(surfels: SurfelSet) -> xr.Dataset:
    """Group "atlas": distortion by the texture coordinates, of the entire face as
    region "all" and of each region.
    """
    measures = distortion(surfels.position, surfels.faces, surfels.uv, surfels.region)
    return dataset(
        {f"atlas_{name}": values for name, values in measures.items()},
        coords={"region": ["all", *surfels.region_names]},
    )


def dome_group(dome: DomeRecord, intensity: Float64) -> xr.Dataset:
    """Group "dome"."""
    cameras = dome.cameras
    lights = dome.lights
    variables = {
        "light_position": [light.position for light in lights],
        "light_axis": [light.axis for light in lights],
        "light_disc_radius": [light.disc_radius for light in lights],
        "light_falloff": [light.falloff for light in lights],
        "light_intensity": intensity,
        "relative_reflectance": int(dome.relative),
        "camera_position": [camera.centre for camera in cameras],
        "camera_matrix": [camera.K for camera in cameras],
        "camera_rotation": [camera.R for camera in cameras],
        "camera_translation": [camera.t for camera in cameras],
        "camera_distortion": [camera.distortion for camera in cameras],
        "camera_size": [(camera.width, camera.height) for camera in cameras],
    }
    if any(light.gain != 1 or any(light.offset) for light in lights):
        variables["light_gain_applied"] = [light.gain for light in lights]
        variables["light_offset_applied"] = [light.offset for light in lights]
    if any(set(camera.gain) != {1.0} for camera in cameras):
        variables["camera_gain_applied"] = [camera.gain for camera in cameras]
    by_light = [light.polarisation for light in lights]
    by_camera = [camera.polarisation for camera in cameras]
    if any(by_light) and any(by_camera):
        variables |= {"light_polarisation": by_light, "camera_polarisation": by_camera}
    return dataset(variables, coords=_dome_names(dome) | CHANNELS)


def calibration_group(
    dome: DomeRecord, calibration: Calibration, rotations: Float64
) -> xr.Dataset:
    """Group "calibration": how well the photographs fit the poses of cameras and scan
    and the positions of the lights.

    `rotations` are the rotation vectors (camera, 3) [degrees] of the refinement.
    """
    variables = {
        "camera_agreement": calibration.camera_agreement,
        "camera_offset": calibration.camera_offset,
        "camera_scale_error": calibration.camera_scale,
        "light_agreement": calibration.light_agreement,
        "camera_brightness": calibration.brightness.camera,
        "light_brightness": calibration.brightness.light,
        "scan_translation_error": calibration.scan_translation,
        "scan_rotation_error": calibration.scan_rotation,
        "camera_rotation_applied": rotations,
    }
    return dataset(variables, coords=_dome_names(dome) | CHANNELS)


def sample_group(dome: DomeRecord, lumitexels: Lumitexels) -> xr.Dataset:
    """Group "samples"; the store reads the spool shard by shard."""
    variables = {
        "reflectance_sample": lumitexels.sample,
        **dict(zip(COUNTS, lumitexels.counts, strict=True)),
        "noise_floor": lumitexels.noise_floor,
    }
    coords = _dome_names(dome) | CHANNELS
    if (noise := lumitexels.noise) is not None:
        variables |= {
            "effective_pixels": noise.effective_pixels,
            "radiance_limit": noise.limit,
            "radiance_read_variance": noise.read_variance,
            "radiance_shot_variance": noise.shot_variance,
        }
        coords["exposure"] = sorted(
            dome.exposures, key=lambda name: -dome.exposures[name]
        )
    return dataset(variables, coords=coords)


def probe_group(
    probe: ProbeRecord,
    profiles: Profiles,
    position: Float64,
    isotropy: Float64 | None = None,
) -> xr.Dataset:
    """Group "probe"; `position` (site, 3) [mm] and p values of isotropy (site, 3)."""
    logs = [
        [probe.pressure.get((site, name)) for name in probe.placements[site]]
        for site in probe.sites
    ]
    variables = {
        "fibre_distance": probe.distance,
        "fibre_profile": profiles.value,
        "fibre_profile_error": profiles.error,
        "site_position": position,
        "gain_known": int(profiles.scale_known),
        "fibre_radius": probe.face,
        "site_pressure": [_mean_pressure(site) for site in logs],
        "site_placements": [len(site) for site in logs],
        "site_repeatability": profiles.repeatability,
    }
    if np.isfinite(probe.azimuth).any():
        variables["fibre_azimuth"] = probe.azimuth
    if isotropy is not None:
        variables["site_isotropy_p_value"] = isotropy
    coords = {"site": list(probe.sites), "fibre": list(probe.fibres)} | CHANNELS
    return dataset(variables, coords=coords)


def sequence_group(sequence: SequenceRecord, dome: DomeRecord) -> xr.Dataset:
    """Group "sequence": the steps of the dome in the order in which they were executed."""
    lights = dome.light_ids
    exposures = list(dome.exposures)
    variables = {
        "step_light": [lights.index(name) for name in sequence.light],
        "step_exposure": [exposures.index(name) for name in sequence.exposure],
        "step_on": sequence.on,
        "step_off": sequence.off,
        "step_trigger_count": sequence.triggers,
    }
    return dataset(variables)


def _mean_pressure(logs: Sequence[Float64 | None]) -> float:
    """Mean pressure over time and placements; NaN for a site without a gauge."""
    means = [log[:, 1].mean() for log in logs if log is not None]
    return float(np.mean(means)) if means else np.nan


def photograph_group(photographs: Mapping[tuple[int, int], Image]) -> xr.Dataset:
    """Group "photographs"; smaller ones are padded with NaN on the right and at the bottom."""
    pairs = sorted(photographs)
    shapes = [photographs[pair].shape for pair in pairs]
    radiance = np.full((len(pairs), *np.max(shapes, axis=0)), np.nan, np.float32)
    for target, pair in zip(radiance, pairs, strict=True):
        image = photographs[pair]
        target[: image.shape[0], : image.shape[1]] = image
    variables = {
        "photograph_radiance": radiance,
        "photograph_light": [light for light, _ in pairs],
        "photograph_camera": [camera for _, camera in pairs],
    }
    return dataset(variables, coords=CHANNELS)


def _dome_names(dome: DomeRecord) -> dict[str, list[str]]:
    return {
        "light": dome.light_ids,
        "camera": dome.camera_ids,
    }

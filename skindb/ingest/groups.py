"""The labelled groups of a version of kind "capture"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.calibration.radiance import Image
from skindb.format.contact_probe import ProbeRecord
from skindb.format.dome import DomeRecord, SequenceRecord
from skindb.format.folder import Capture
from skindb.geometry.atlas import distortion
from skindb.geometry.camera import camera_centre
from skindb.ingest.consistency import Calibration
from skindb.ingest.lumitexels import FULL_SHADOW, MIN_LIT_FRACTION, Lumitexels
from skindb.ingest.probe_profiles import Profiles
from skindb.ingest.surfels import SurfelSet, transferred_landmarks
from skindb.schema import dataset

Array = NDArray[np.float64]
CHANNELS = ("R", "G", "B")


def surfel_group(
    surfels: SurfelSet,
    dome: DomeRecord | None = None,
    light_fraction: NDArray[np.float16] | None = None,
    camera_share: NDArray[np.float16] | None = None,
) -> xr.Dataset:
    """Group "surfels"; without a dome it has no visibility."""
    variables: dict[str, Any] = {
        "surfel_position": surfels.position,
        "surfel_normal": surfels.normal,
        "surfel_area": surfels.area,
        "surfel_radius": surfels.radius,
        "surfel_uv": surfels.uv,
        "region_mask": surfels.region.astype(np.int8),
    }
    coords: dict[str, list[str]] = {"region": list(surfels.region_names)}
    if dome is not None:
        variables |= {
            "light_visible_fraction": light_fraction,
            "camera_visible_fraction": camera_share,
        }
        variables["soft_light_count"] = np.zeros(len(surfels.position), np.int32)
        # not all at once: memory
        for share in () if light_fraction is None else light_fraction.T:
            variables["soft_light_count"] += (share >= FULL_SHADOW) & (
                share < MIN_LIT_FRACTION
            )
        coords |= _dome_names(dome)
    if not surfels.region_names:
        variables.pop("region_mask")
        coords.pop("region")
    return dataset(variables, coords=coords)


def mesh_group(capture: Capture, surfels: SurfelSet) -> xr.Dataset:
    """Group "mesh"."""
    if not capture.landmarks:
        return dataset({"triangle": surfels.faces})
    position, distance = transferred_landmarks(capture, surfels)
    variables = {
        "triangle": surfels.faces,
        "landmark_position": position,
        "landmark_surface_distance": distance,
    }
    return dataset(variables, coords={"landmark": [*capture.landmarks]})


def atlas_group(surfels: SurfelSet) -> xr.Dataset:
    """Group "atlas": distortion by the texture coordinates, of the entire face as
    region "all" and of each region.

    Its attribute `weights` names the method: "intrinsic" (Desbrun et al. 2002) or
    "mean_value" (Floater 2003).
    """
    found = distortion(surfels.position, surfels.faces, surfels.uv, surfels.region)
    variables = {f"atlas_{name}": values for name, values in found.items()}
    return dataset(
        variables,
        coords={"region": ["all", *surfels.region_names]},
        attrs={"weights": surfels.uv_weights},
    )


def dome_group(dome: DomeRecord, intensity: Array) -> xr.Dataset:
    """Group "dome"."""
    cameras = dome.cameras
    lights = dome.lights
    variables = {
        "light_position": [light.position for light in lights],
        "light_axis": [light.axis for light in lights],
        "light_disc_radius": [light.disc_radius for light in lights],
        "light_falloff": [light.falloff for light in lights],
        "light_intensity": intensity,
        "camera_position": [camera_centre(camera.R, camera.t) for camera in cameras],
        "camera_matrix": [camera.K for camera in cameras],
        "camera_rotation": [camera.R for camera in cameras],
        "camera_translation": [camera.t for camera in cameras],
        "camera_distortion": [camera.distortion for camera in cameras],
        "camera_size": [(camera.width, camera.height) for camera in cameras],
    }
    return dataset(variables, coords=_dome_names(dome) | {"channel": list(CHANNELS)})


def calibration_group(
    dome: DomeRecord, found: Calibration, applied: NDArray[np.float64]
) -> xr.Dataset:
    """Group "calibration": how well the photographs fit the poses of cameras and scan
    and the positions of the lights.

    `applied` are the rotation vectors (camera, 3) [degrees] of the refinement.
    """
    variables = {
        "camera_agreement": found.camera_agreement,
        "camera_offset": found.camera_offset,
        "camera_scale_error": found.camera_scale,
        "light_agreement": found.light_agreement,
        "camera_brightness": found.brightness.camera,
        "light_brightness": found.brightness.light,
        "scan_translation_error": found.scan_translation,
        "scan_rotation_error": found.scan_rotation,
        "camera_rotation_applied": applied,
    }
    return dataset(variables, coords=_dome_names(dome) | {"channel": list(CHANNELS)})


def sample_group(dome: DomeRecord, found: Lumitexels) -> xr.Dataset:
    """Group "samples"; the store reads the spool shard by shard."""
    variables = {
        "reflectance_sample": found.sample,
        "sample_count": found.sample_count,
        "saturated_count": found.saturated_count,
        "dark_count": found.dark_count,
        "single_exposure_count": found.single_count,
        "noise_floor": found.noise_floor,
        "shot_noise": found.shot_noise,
    }
    coords = _dome_names(dome) | {"channel": list(CHANNELS)}
    if (noise := found.noise) is not None:
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
    position: Array,
    isotropy: Array | None = None,
) -> xr.Dataset:
    """Group "probe"; `position` (site, 3) [mm] and p values of isotropy (site, 3)."""
    variables = {
        "fibre_distance": probe.distance,
        "fibre_profile": profiles.value,
        "fibre_profile_error": profiles.error,
        "site_position": position,
        "gain_known": int(profiles.scale_known),
        "fibre_radius": probe.face,
        "site_pressure": _mean_pressures(probe),
        "site_placements": [len(probe.placements[site]) for site in probe.sites],
        "site_repeatability": profiles.repeatability,
    }
    if np.isfinite(probe.azimuth).any():
        variables["fibre_azimuth"] = probe.azimuth
    if isotropy is not None:
        variables["site_isotropy_p_value"] = isotropy
    if any(len(own) > 1 for own in probe.placements.values()):
        variables["placement_profile"] = _padded(profiles.placements)
    logs = [
        [probe.pressure.get((site, name)) for name in probe.placements[site]]
        for site in probe.sites
    ]
    if any(log is not None and len(log) > 1 for site in logs for log in site):
        # (site, placement, sample, time and pressure); a value without a time is a log
        # with one entry
        empty = np.full((0, 2), np.nan)
        padded = _padded(
            [_padded([empty if log is None else log for log in site]) for site in logs]
        )
        variables |= {"pressure_time": padded[..., 0], "pressure": padded[..., 1]}
    return dataset(
        variables,
        coords={
            "site": list(probe.sites),
            "fibre": list(probe.fibres),
            "channel": list(CHANNELS),
        },
    )


def sequence_group(sequence: SequenceRecord, dome: DomeRecord) -> xr.Dataset:
    """Group "sequence": the steps of the dome in the order in which they were executed."""
    lights = [light.id for light in dome.lights]
    exposures = list(dome.exposures)
    variables = {
        "step_light": [lights.index(name) for name in sequence.light],
        "step_exposure": [exposures.index(name) for name in sequence.exposure],
        "step_on": sequence.on,
        "step_off": sequence.off,
        "step_trigger_count": sequence.triggers,
    }
    return dataset(variables)


def _mean_pressures(probe: ProbeRecord) -> list[float]:
    """Mean pressure (site,) over time and placements; NaN for a site without a gauge."""
    logs = [
        [probe.pressure.get((site, name)) for name in probe.placements[site]]
        for site in probe.sites
    ]
    means = [[log[:, 1].mean() for log in site if log is not None] for site in logs]
    return [float(np.mean(site)) if site else np.nan for site in means]


def _padded(arrays: Sequence[Array]) -> Array:
    """Arrays stacked along a new first axis, NaN where one is shorter."""
    shape = np.max([one.shape for one in arrays], axis=0)
    out = np.full((len(arrays), *shape), np.nan)
    for i, one in enumerate(arrays):
        out[i][tuple(slice(size) for size in one.shape)] = one
    return out


def photograph_group(photographs: Mapping[tuple[int, int], Image]) -> xr.Dataset:
    """Group "photographs"; smaller ones are padded with NaN on the right and at the bottom."""
    pairs = sorted(photographs)
    height, width = (
        max(photographs[pair].shape[axis] for pair in pairs) for axis in (0, 1)
    )
    radiance = np.full((len(pairs), height, width, 3), np.nan, np.float32)
    for i, pair in enumerate(pairs):
        image = photographs[pair]
        radiance[i, : image.shape[0], : image.shape[1]] = image
    variables = {
        "photograph_radiance": radiance,
        "photograph_light": [light for light, _ in pairs],
        "photograph_camera": [camera for _, camera in pairs],
    }
    return dataset(variables, coords={"channel": list(CHANNELS)})


def _dome_names(dome: DomeRecord) -> dict[str, list[str]]:
    return {
        "light": [light.id for light in dome.lights],
        "camera": [camera.id for camera in dome.cameras],
    }

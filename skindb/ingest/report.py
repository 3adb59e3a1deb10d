"""Report of an ingest: repairs of the scan; number of samples by surfel, region, camera
and light.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from skindb.format.dome import DomeRecord
from skindb.format.folder import WHOLE_SURFACE
from skindb.ingest.lumitexels import Lumitexels
from skindb.ingest.surfels import SurfelSet

QUANTILES = {"p5": 0.05, "p50": 0.5, "p95": 0.95, "max": 1.0}
COLUMNS = ("mean", *QUANTILES, "seen")


def cleaning_lines(provenance: Mapping[str, Any], *, places: bool) -> list[str]:
    """A line for every kind of repair, optionally with the `places` of the first ones,
    x y z in mm.
    """
    kept = provenance.get("cleaning_places", {}) if places else {}
    lines = []
    for kind, count in provenance.get("cleaning", {}).items():
        lines.append(f"{kind}: {count}")
        lines += [f"  at {x:.2f} {y:.2f} {z:.2f}" for x, y, z in kept.get(kind, [])]
        if kind in kept and count > len(kept[kind]):
            lines.append(f"  and {count - len(kept[kind]):,} more")
    return lines


def describe_samples(
    found: Lumitexels, surfels: SurfelSet, dome: DomeRecord
) -> dict[str, Any]:
    """Samples per sampled surfel and fraction of sampled surfels, also by region;
    devices without samples.

    Also the fraction of the samples that come from a single exposure.
    """
    count = found.sample_count
    parts = {WHOLE_SURFACE: np.ones(len(count), bool)}
    parts |= {name: surfels.region[:, k] for k, name in enumerate(surfels.region_names)}
    return {
        "of": int(found.view_count.size),
        "surfels": len(count),
        "parts": {name: _quantiles(count[part]) for name, part in parts.items()},
        "single_exposure_fraction": round(
            float(found.single_count.sum() / max(count.sum(), 1)), 4
        ),
        "cameras": {
            c.id: int(n)
            for c, n in zip(dome.cameras, found.view_count.sum(axis=0), strict=True)
        },
        "lights_without": [
            x.id
            for x, n in zip(dome.lights, found.view_count.sum(axis=1), strict=True)
            if n == 0
        ],
    }


def sample_lines(samples: Mapping[str, Any]) -> list[str]:
    """Summary of the samples, and a line for every camera and light without a sample."""
    whole = samples["parts"][WHOLE_SURFACE]
    said = ", ".join(f"{name} {whole[name]:,}" for name in QUANTILES)
    lines = [
        f"samples per surfel: mean {whole['mean']:,} ({said}) of {samples['of']:,}; "
        f"{whole['seen']:.0%} of {samples['surfels']:,} surfels have any"
    ]
    # unknown for captures of an earlier version
    if fraction := samples.get("single_exposure_fraction"):
        lines[0] += f"; {fraction:.1%} of the samples come from a single exposure"
    lines += [
        f"camera {name}: no sample" for name, n in samples["cameras"].items() if n == 0
    ]
    return lines + [f"light {name}: no sample" for name in samples["lights_without"]]


def calibration_lines(calibration: xr.Dataset) -> list[str]:
    """Agreement of photographs, scan and calibration, in one line."""
    if not np.isfinite(calibration["camera_agreement"]).any():
        return ["calibration: not checked, as the photographs show too little"]
    move, turn = (
        float(np.linalg.norm(calibration[f"scan_{name}_error"]))
        for name in ("translation", "rotation")
    )
    return [
        f"calibration: scan {move:.1f} mm and {turn:.1f} degrees from where the "
        "photographs show the face; "
        f"cameras up to {float(calibration['camera_offset'].max()):.1f} mm off; "
        f"lights agree by {float(calibration['light_agreement'].min()):.2f} or more"
    ]


def calibration_table(calibration: xr.Dataset) -> list[list[Any]]:
    """Header and rows: offset [mm] and scale [%] of each camera, agreement and
    brightness of cameras and lights.
    """
    rows: list[list[Any]] = [
        ["device", "offset [mm]", "larger by [%]", "agreement", "brightness"]
    ]
    cameras = [
        calibration[f"camera_{name}"].values
        for name in ("offset", "scale_error", "agreement", "brightness")
    ]
    for name, offset, scale, agreement, factors in zip(
        calibration["camera"].values, *cameras, strict=True
    ):
        brightness = " ".join(f"{factor:.2f}" for factor in factors)
        rows.append(
            [
                f"camera {name}",
                f"{offset:.2f}",
                f"{100 * scale:.1f}",
                f"{agreement:.3f}",
                brightness,
            ]
        )
    lights = [
        calibration[f"light_{name}"].values for name in ("agreement", "brightness")
    ]
    for name, agreement, factor in zip(
        calibration["light"].values, *lights, strict=True
    ):
        rows.append([f"light {name}", "-", "-", f"{agreement:.3f}", f"{factor:.2f}"])
    return rows


def sample_table(samples: Mapping[str, Any]) -> list[list[Any]]:
    """Header and rows: samples per surfel, by region."""
    return [
        ["samples of", *COLUMNS],
        *[
            [name, *(part[column] for column in COLUMNS)]
            for name, part in samples["parts"].items()
        ],
    ]


def _quantiles(count: Any) -> dict[str, float]:
    seen = count[count > 0]
    if not len(seen):
        return dict.fromkeys(COLUMNS, 0)
    values = {name: round(float(np.quantile(seen, q))) for name, q in QUANTILES.items()}
    return {
        "mean": round(float(seen.mean())),
        **values,
        "seen": round(len(seen) / len(count), 4),
    }

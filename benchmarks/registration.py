"""Errors of a common (u, v): correspondences of virtual heads with known corresponding
points, and regions.

    python -m benchmarks registration CAPTURE ... [--shared N] [--stride N] [--brief]

Only the scan, landmarks and regions of the folder CAPTURE are read, not its frames. The
vertices of the truth must be the same points of every head, or the first N of them.
Prints Markdown tables: errors in mm by region without and with the warp, for the
unchanged scans and for scans that end at different places; errors in mm by number of
landmarks, errors of clicks and smoothing; agreement of regions from landmarks with those
of the captures.
Use other heads than those on which thresholds were chosen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.truth import read_truth
from benchmarks.truth import regions as true_regions
from skindb.analysis import register
from skindb.analysis.regions import own_masks, region_masks
from skindb.analysis.registration import interpolate, surface_of
from skindb.format.folder import read_capture
from skindb.geometry.atlas import disc_atlas
from skindb.geometry.clean import clean_mesh
from skindb.geometry.mesh import closest_on_mesh
from skindb.geometry.rays import RayScene
from skindb.ingest.groups import mesh_group, surfel_group
from skindb.ingest.surfels import build_surfels
from skindb.schema import dataset, variables

Array = NDArray[np.floating[Any]]
Models = dict[str, xr.DataTree]
HEIGHT = 1e-2  # of the plane from which rays start, in units of uv
COUNTS = (20, 16, 12, 8, 5, 3, 2)
SMOOTHINGS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
CLICKS = (0.5, 1.0, 2.0, 3.0)  # mm rms, each axis
CUTS = (None, 25.0, 40.0, None, 10.0)  # mm below the chin, for one take after another
BACK = 25.0  # mm that are cut off at the back of the head
PRESENT = 3.0  # mm from the scan; farther points are not on it
# region from landmarks -> names of the same region in other data
BESIDE = {"neck": ("neck", "neck_beard")}


def corresponding_points(
    model: xr.DataTree, registered: xr.Dataset, common: Array
) -> Array:
    """Surface points (n, 3) [mm] of a take at common texture coordinates (n, 2); NaN
    outside its surface.
    """
    position, _, faces = surface_of(model)
    # the map has no folds: a ray perpendicular to the plane meets the only triangle
    # that contains the point
    flat = RayScene(
        np.pad(registered[variables.COMMON_UV].values.astype(float), ((0, 0), (0, 1))),
        faces,
    )
    start = np.pad(np.asarray(common, float), ((0, 0), (0, 1)), constant_values=HEIGHT)
    face, corner, _ = flat.first_hit(start, np.array([[0.0, 0.0, -1.0]]))
    return np.where(
        (face >= 0)[:, None],
        interpolate(position, faces[np.maximum(face, 0)], corner),
        np.nan,
    )


def correspondence_error(
    models: Models, registered: Mapping[str, xr.Dataset], points: Mapping[str, Array]
) -> Array:
    """Errors of correspondences at points where the true ones are known.

    Parameters
    ----------
    models
        Take -> version of kind "model".
    registered
        From `register` of these takes, or `unregistered`.
    points
        Take -> (p, 3) points [mm] on or near the surface; row i is the same anatomical
        point of every face.

    Returns
    -------
    ndarray
        (pair, p) distances [mm] for every ordered pair of takes, between point i of the
        first take and the point of its surface that corresponds to point i of the
        second; NaN where there is no corresponding point.
    """
    true = {}
    common = {}
    for take, positions in points.items():
        position, _, faces = surface_of(models[take])
        face, corner, _ = closest_on_mesh(position, faces, positions)
        true[take] = interpolate(position, faces[face], corner)
        common[take] = interpolate(
            registered[take][variables.COMMON_UV].values, faces[face], corner
        )
    error = []
    # all others at once, because every call builds a ray tracing scene
    for b in points:
        places = np.concatenate([common[a] for a in points if a != b])
        matches = corresponding_points(models[b], registered[b], places).reshape(
            len(points) - 1, -1, 3
        )
        error.append(np.linalg.norm(matches - true[b], axis=2))
    return np.concatenate(error)


def unregistered(models: Models) -> dict[str, xr.Dataset]:
    """The texture coordinates of each take as if they were common: the baseline for the
    errors of a registration.
    """
    return {
        take: dataset({variables.COMMON_UV: surface_of(model)[1]})
        for take, model in models.items()
    }


def mask_agreement(
    mask: NDArray[np.bool_], reference: NDArray[np.bool_], area: Array
) -> float:
    """Area of the intersection of two masks divided by the area of their union; NaN if
    both are empty.
    """
    either = float(area[mask | reference].sum())
    return float(area[mask & reference].sum()) / either if either else float("nan")


def scanned(folder: Path, spacing_mm: float) -> xr.DataTree:
    """Groups of a take that a registration reads, made from the scan as by ingest."""
    capture = read_capture(folder)
    surfels = build_surfels(capture, spacing_mm=spacing_mm)
    return xr.DataTree.from_dict(
        {"fitted": surfel_group(surfels), "mesh": mesh_group(capture, surfels)}
    )


def with_landmarks(
    models: Models, chosen: NDArray[np.int64], *, click: float = 0.0, seed: int = 0
) -> Models:
    """The takes with some of their landmarks, each displaced by a random error of `click` mm."""
    rng = np.random.default_rng(seed)
    out = {}
    for take, model in models.items():
        mesh = model["mesh"].to_dataset().isel(landmark=chosen)
        moved = mesh["landmark_position"] + click * rng.normal(
            size=mesh["landmark_position"].shape
        )
        mesh = mesh.assign(
            landmark_position=mesh["landmark_position"].copy(data=moved.values)
        )
        out[take] = xr.DataTree.from_dict(
            {"fitted": model["fitted"].to_dataset(), "mesh": mesh}
        )
    return out


def cut_differently(models: Models) -> Models:
    """The takes with scans that are cut below the chin and at the back, and with new
    texture coordinates.
    """
    out = {}
    for i, (take, model) in enumerate(models.items()):
        below = CUTS[i % len(CUTS)]
        if below is None:
            out[take] = model
            continue
        position = (
            model["fitted"].to_dataset()["surfel_position"].values.astype(np.float64)
        )
        mesh = model["mesh"].to_dataset()
        corners = position[mesh["triangle"].values]
        low = float(mesh["landmark_position"].sel(landmark="chin")[1]) - below
        inside = (corners[..., 1].min(axis=1) > low) & (
            corners[..., 2].min(axis=1) > position[:, 2].min() + BACK
        )
        piece = clean_mesh(position, mesh["triangle"].values[inside].astype(np.int64))
        uv, _ = disc_atlas(piece.vertices, piece.faces)
        out[take] = xr.DataTree.from_dict(
            {
                "fitted": dataset({"surfel_position": piece.vertices, "surfel_uv": uv}),
                "mesh": mesh[["landmark_position"]].merge(
                    dataset({"triangle": piece.faces})
                ),
            }
        )
    return out


def spread_order(points: Array) -> NDArray[np.int64]:
    """Order of landmarks (k, 3) in which the first ones are as far from each other as possible."""
    order = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    while len(order) < len(points):
        away = np.linalg.norm(points[:, None] - points[order], axis=2).min(axis=1)
        order.append(int(away.argmax()))
    return np.array(order)


def on_both(models: Models, points: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Mask (pair, p) of `correspondence_error` for points that are on both scans."""
    tree = {
        take: cKDTree(model["fitted"].to_dataset()["surfel_position"].values)
        for take, model in models.items()
    }
    present = {take: tree[take].query(p)[0] < PRESENT for take, p in points.items()}
    return np.concatenate(
        [[present[a] & present[b] for a in points if a != b] for b in points]
    )


def cell(error: Array) -> str:
    """Median, mean and 95 % quantile in mm."""
    return f"{np.nanmedian(error):.2f}, {np.nanmean(error):.2f}, {np.nanquantile(error, 0.95):.1f}"


def by_region(
    errors: Mapping[str, Array], region: NDArray[Any], face: NDArray[np.bool_]
) -> None:
    """Print errors by region (rows) and by method for a common (u, v) (columns)."""
    print(f"| median, mean, 95 % [mm] | points | {' | '.join(errors)} |")
    print("|---|" + "---|" * (1 + len(errors)))
    rows = {"all": np.ones(len(region), bool), "face": face} | {
        name: region == name for name in sorted({*region.tolist()})
    }
    for name, inside in rows.items():
        print(
            (
                f"| {name} | {inside.sum()} | "
                f"{' | '.join(cell(e[:, inside]) for e in errors.values())} |"
            ),
            flush=True,
        )


def against(
    models: Models,
    points: Mapping[str, Array],
    face: NDArray[np.bool_],
    cases: list[dict[str, Any]],
) -> None:
    """Print one row per case, with errors over the face and over all points."""
    order = spread_order(
        next(iter(models.values()))["mesh"]
        .to_dataset()["landmark_position"]
        .values.astype(float)
    )
    print(
        "\n| landmarks | click [mm] | smoothing | warp | face [mm] | "
        "all [mm] | anchors | flipped |"
    )
    print("|---|" + 7 * "---|")
    for case in cases:
        count = case.get("count", len(order))
        click = case.get("click", 0.0)
        smoothing = case.get("smoothing")
        takes = with_landmarks(models, np.sort(order[:count]), click=click)
        registered = register(takes, smoothing=smoothing)
        error = correspondence_error(takes, registered, points)
        kinds = ", ".join(
            sorted({result.attrs["warp_kind"] for result in registered.values()})
        )
        smoothings = [result.attrs["warp_smoothing"] for result in registered.values()]
        range_text = (
            f"{max(smoothings):.3g}"
            if max(smoothings) == min(smoothings)
            else f"{min(smoothings):.3g} to {max(smoothings):.3g}"
        )
        row = f"| {count} | {click:g} | {range_text} | {kinds} |"
        anchors, flips = (
            sum(result.attrs[f"warp_{name}"] for result in registered.values())
            for name in ("anchors", "flips")
        )
        print(
            row,
            f"{cell(error[:, face])} | {cell(error)} | {anchors} | {flips} |",
            flush=True,
        )


def regions(models: Models, registered: Mapping[str, xr.Dataset]) -> None:
    """Print the agreement of regions from landmarks with those of the captures."""
    print("\n| region | intersection over union of areas, mean | worst take |")
    print("|---|---|---|")
    rows: dict[str, list[float]] = {}
    for take, model in models.items():
        fitted = model["fitted"].to_dataset()
        result = registered[take]
        masks = own_masks(fitted)
        area = fitted["surfel_area"].values
        named = {
            str(n): result["common_landmark"].sel(landmark=n).values
            for n in result["landmark"].values
        }
        for name, mask in region_masks(result["common_uv"].values, named).items():
            parts = [masks[part] for part in BESIDE.get(name, (name,)) if part in masks]
            if parts:
                rows.setdefault(name, []).append(
                    mask_agreement(mask, np.any(parts, axis=0), area)
                )
    for name, values in rows.items():
        print(f"| {name} | {np.mean(values):.2f} | {min(values):.2f} |")


def main(
    capture: Sequence[Path],
    *,
    spacing: Annotated[float, "Spacing of surfels [mm]."] = 4.0,
    shared: Annotated[
        int | None, "Number of leading vertices that all heads share (default: all)."
    ] = None,
    stride: Annotated[int, "Use every N-th of them."] = 3,
    outside: Annotated[
        str, "Regions that are not part of the face."
    ] = "ear,scalp,neck,neck_beard,other",
    brief: Annotated[bool, "Skip the table by landmarks and smoothing."] = False,
) -> None:
    """Print the tables."""
    models = {folder.name: scanned(folder, spacing) for folder in capture}
    points = {}
    truths = [read_truth(folder) for folder in capture]
    for folder, truth in zip(capture, truths, strict=True):
        points[folder.name] = truth["vertices"][:shared:stride].astype(np.float64)
    region = true_regions(truths[-1])[:shared:stride]
    face = ~np.isin(region, outside.split(","))
    reference = sorted(models)[0]
    cut = cut_differently(models)
    for title, takes in {
        "Unchanged scans": models,
        "Scans that end at different places": cut,
    }.items():
        ways = {"own (u, v)": unregistered(takes), "mean of all": register(takes)}
        ways |= {f"{reference} as reference": register(takes, reference=reference)}
        both = on_both(takes, points)
        errors = {
            n: np.where(both, correspondence_error(takes, registered, points), np.nan)
            for n, registered in ways.items()
        }
        print(f"\n{title}:\n")
        by_region(errors, region, face)
        lost = ", ".join(
            f"{name} {np.isnan(e[both]).mean():.1%}" for name, e in errors.items()
        )
        print(f"\nPoints without a correspondence on the other head: {lost}.")
    cases: list[dict[str, Any]] = [{"count": count} for count in COUNTS]
    cases += [{"click": value} for value in CLICKS]
    cases += [
        {"smoothing": value, "click": click}
        for click in (0.0, 2.0)
        for value in SMOOTHINGS
    ]
    if not brief:
        against(models, points, face, cases)
    regions(models, register(models))

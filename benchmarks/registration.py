"""How far is a common (u, v) off? Correspondences of virtual heads, whose points are known, and regions.

    python benchmarks/registration.py DB TAKE=TRUTH.npz ... [--shared N] [--every N] [--brief]

DB holds models of the takes. TRUTH.npz holds `vertices` (v, 3) in mm, `region` (v,) and `region_names`; its first N
vertices are the same points of every head. Prints Markdown tables: mm by region without and with the warp; mm against
the number of landmarks, smoothing and errors of clicks; mm of scans that end at different places; how far regions by
landmarks agree with the captures' own.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

import skindb
from skindb.analysis import correspondence_error, mask_agreement, register
from skindb.analysis.masks import own_masks, region_masks
from skindb.analysis.registration import unregistered
from skindb.geometry.atlas import disc_atlas
from skindb.geometry.clean import clean_mesh
from skindb.schema import dataset

Array = NDArray[np.floating[Any]]
Models = dict[str, xr.DataTree]
COUNTS = (20, 16, 12, 8, 5, 3, 2)
SMOOTHINGS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
CLICKS = (0.5, 1.0, 2.0, 4.0)  # mm rms, each axis
CUTS = (None, 25.0, 40.0, None, 10.0)  # mm below the chin, take after take
BACK = 25.0  # mm that such a cut takes off behind
BESIDE = {"neck": ("neck", "neck_beard")}  # a region by landmarks -> what heads of another naming call it


def in_memory(models: Models) -> Models:
    """What a registration reads of the takes."""
    names = ["surfel_position", "surfel_uv", "surfel_area", "region_mask"]
    out = {}
    for take, model in models.items():
        fitted = model["fitted"].to_dataset()
        groups = {"fitted": fitted[[n for n in names if n in fitted]].load(), "mesh": model["mesh"].to_dataset().load()}
        out[take] = xr.DataTree.from_dict(groups)
    return out


def with_landmarks(models: Models, chosen: NDArray[np.int64], *, click: float = 0.0, seed: int = 0) -> Models:
    """The takes with some of their landmarks, each moved by an error of `click` mm."""
    rng, out = np.random.default_rng(seed), {}
    for take, model in models.items():
        mesh = model["mesh"].to_dataset().isel(landmark=chosen)
        moved = mesh["landmark_position"] + click * rng.normal(size=mesh["landmark_position"].shape)
        mesh = mesh.assign(landmark_position=mesh["landmark_position"].copy(data=moved.values))
        out[take] = xr.DataTree.from_dict({"fitted": model["fitted"].to_dataset(), "mesh": mesh})
    return out


def cut_differently(models: Models) -> Models:
    """The takes as if their scans ended elsewhere: below the chin and behind, with texture coordinates made anew."""
    out = {}
    for i, (take, model) in enumerate(models.items()):
        below = CUTS[i % len(CUTS)]
        if below is None:
            out[take] = model
            continue
        position = model["fitted"].to_dataset()["surfel_position"].values.astype(np.float64)
        mesh = model["mesh"].to_dataset()
        corners = position[mesh["triangle"].values]
        low = float(mesh["landmark_position"].sel(landmark="chin")[1]) - below
        kept = (corners[..., 1].min(axis=1) > low) & (corners[..., 2].min(axis=1) > position[:, 2].min() + BACK)
        piece = clean_mesh(position, mesh["triangle"].values[kept].astype(np.int64))
        uv, _ = disc_atlas(piece.vertices, piece.faces)
        out[take] = xr.DataTree.from_dict({
            "fitted": dataset({"surfel_position": piece.vertices, "surfel_uv": uv}),
            "mesh": mesh[["landmark_position"]].merge(dataset({"triangle": piece.faces})),
        })  # fmt: skip
    return out


def spread_order(points: Array) -> NDArray[np.int64]:
    """Landmarks (k, 3) so that the first ones are as far from each other as can be."""
    order = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    while len(order) < len(points):
        away = np.linalg.norm(points[:, None] - points[order], axis=2).min(axis=1)
        order.append(int(away.argmax()))
    return np.array(order)


def cell(error: Array) -> str:
    """Median and 95 % in mm."""
    return f"{np.nanmedian(error):.2f} / {np.nanquantile(error, 0.95):.2f}"


def by_region(errors: Mapping[str, Array], region: NDArray[Any]) -> None:
    """Rows are regions, columns ways to a common (u, v)."""
    print(f"| median / 95 % [mm] | points | {' | '.join(errors)} |")
    print("|---|" + "---|" * (1 + len(errors)))
    for name in ["all", *sorted(set(region.tolist()))]:
        inside = np.ones(len(region), bool) if name == "all" else region == name
        print(f"| {name} | {inside.sum()} | {' | '.join(cell(e[:, inside]) for e in errors.values())} |", flush=True)


def against(models: Models, points: Mapping[str, Array], face: NDArray[np.bool_], cases: list[dict[str, Any]]) -> None:
    """A row a case, over the face and over all points."""
    order = spread_order(next(iter(models.values()))["mesh"].to_dataset()["landmark_position"].values.astype(float))
    print("\n| landmarks | click [mm] | smoothing | warp | condition | face, median / 95 % [mm] | all |")
    print("|---|---|---|---|---|---|---|")
    for case in cases:
        count, click, smoothing = case.get("count", len(order)), case.get("click", 0.0), case.get("smoothing")
        takes = with_landmarks(models, np.sort(order[:count]), click=click)
        found = register(takes, smoothing=smoothing)
        error = correspondence_error(takes, found, points)
        kinds = ", ".join(sorted({one.attrs["warp_kind"] for one in found.values()}))
        used = [one.attrs["warp_smoothing"] for one in found.values()]
        condition = max(one.attrs["warp_condition"] for one in found.values())
        said = f"{max(used):.3g}" if max(used) == min(used) else f"{min(used):.3g} to {max(used):.3g}"
        row = f"| {count} | {click:g} | {said} | {kinds} | {condition:.0f} |"
        print(row, f"{cell(error[:, face])} | {cell(error)} |", flush=True)


def regions(models: Models, registered: Mapping[str, xr.Dataset]) -> None:
    """Agreement of regions by landmarks with those that came with the captures."""
    print("\n| region | area both cover over area either covers, mean | worst take |")
    print("|---|---|---|")
    rows: dict[str, list[float]] = {}
    for take, model in models.items():
        fitted, one = model["fitted"].to_dataset(), registered[take]
        own, area = own_masks(fitted), fitted["surfel_area"].values
        named = {str(n): one["common_landmark"].sel(landmark=n).values for n in one["landmark"].values}
        for name, mask in region_masks(one["common_uv"].values, named).items():
            parts = [own[part] for part in BESIDE.get(name, (name,)) if part in own]
            if parts:
                rows.setdefault(name, []).append(mask_agreement(mask, np.any(parts, axis=0), area))
    for name, values in rows.items():
        print(f"| {name} | {np.mean(values):.2f} | {min(values):.2f} |")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("db")
    parser.add_argument("truth", nargs="+", metavar="TAKE=TRUTH.npz")
    parser.add_argument("--shared", type=int, default=9409, help="leading vertices all heads share")
    parser.add_argument("--every", type=int, default=3, help="take every so many of them")
    parser.add_argument("--outside", default="ear,scalp,neck,neck_beard,other", help="regions that are not the face")
    parser.add_argument("--brief", action="store_true", help="without the table against landmarks and smoothing")
    args = parser.parse_args()
    database, paths = skindb.open(args.db), dict(one.split("=", 1) for one in args.truth)
    models = in_memory({take: database.read("model", take) for take in paths})
    points, region = {}, np.zeros(0, str)
    for take, path in paths.items():
        with np.load(path) as truth:
            points[take] = truth["vertices"][: args.shared : args.every].astype(np.float64)
            region = truth["region_names"][truth["region"][: args.shared : args.every]]
    face = ~np.isin(region, args.outside.split(","))
    names = sorted(paths)
    found = {
        "own (u, v)": unregistered(models),
        "mean of all": register(models),
        f"{names[0]} as reference": register(models, reference=names[0]),
    }
    errors = {name: correspondence_error(models, one, points) for name, one in found.items()}
    by_region(errors, region)
    lost = ", ".join(f"{name} {np.isnan(e).mean():.1%}" for name, e in errors.items())
    print(f"\nPoints without a place on the other head: {lost}.")
    cases: list[dict[str, Any]] = [{"count": count} for count in COUNTS]
    cases += [{"smoothing": value} for value in SMOOTHINGS[1:]]
    cases += [{"click": value} for value in CLICKS] + [
        {"click": 2.0, "smoothing": 0.1},
        {"click": 4.0, "smoothing": 0.1},
    ]
    if not args.brief:
        against(models, points, face, cases)
    cut, on_face = cut_differently(models), {take: p[face] for take, p in points.items()}
    print("\nScans that end at different places:\n")
    ways = {"own (u, v)": unregistered(cut), "mean of all": register(cut)}
    by_region({name: correspondence_error(cut, one, on_face) for name, one in ways.items()}, region[face])
    regions(models, found["mean of all"])


if __name__ == "__main__":
    main()

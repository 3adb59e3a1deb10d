"""Files with measured BRDFs: .npz files of tables, or folders of MERL binaries."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.files import private_file
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.merl import read_merl_folder
from skindb.reflectance.resample import hole_fraction, to_default_grid
from skindb.reflectance.tables import DEFAULT_GRID, directional_albedo
from skindb.types import Array

TABLE = "basis_brdf"
NODES = ("theta_h", "theta_d", "phi_d")
UNITS = ("sr-1", "sr^-1", "1/sr")
# of the nodes above the horizon, above which a table is mostly extrapolated
MAX_HOLE_FRACTION = 0.5


def read_dictionary(path: str | Path) -> Dictionary:
    """Read the dictionary in a folder of MERL binaries, an .npz file of tables, or the
    folder `bases` of an export.
    """
    path = Path(path)
    # bases.npz of an export stores its disc, the MERL files beside it do not
    if path.is_dir():
        inside = path / "bases.npz"
        return read_tables(inside) if inside.is_file() else read_merl_folder(path)
    return read_tables(path)


def read_tables(path: str | Path) -> Dictionary:
    """Read tables of measured BRDFs, resampled to the default grid.

    Parameters
    ----------
    path
        An .npz file with `basis_brdf` (material, theta_h, theta_d, phi_d), or with RGB
        as the last axis, in sr^-1, NaN where it was not measured; and its nodes
        `theta_h` and `theta_d` in [0, pi/2] and `phi_d` in [0, pi), in ascending order
        [rad]. Optional arrays are `names` (material,), `units`, and
        `disc_angular_radius` [rad] of the lights over which the tables are averaged.
        `bases.npz` of an export is such a file; `write_tables` writes one.

    Raises
    ------
    InputError
        With every fault of the file.
    """
    path = Path(path)
    arrays = _load(path)
    faults = [
        *_node_faults(path, arrays),
        *_shape_faults(path, arrays),
        *_unit_faults(path, arrays),
    ]
    faults = faults or _value_faults(path, arrays)
    if faults:
        raise InputError(faults)
    brdf = arrays[TABLE]
    nodes = (arrays["theta_h"], arrays["theta_d"], arrays["phi_d"])
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    resampled = [
        to_default_grid(
            _channel_mean(brdf_of_material), nodes, "a file of tables", digest
        )
        for brdf_of_material in brdf
    ]
    table = np.stack([table for table, _ in resampled], axis=-1)
    albedo = directional_albedo(table, 1.0)[0]
    if albedo.max() > 2:  # more than an error of measurement explains
        rule = "a surface must not reflect more light than it receives"
        cure = "provide values in sr^-1"
        raise InputError(
            Fault(
                f"{path}[{TABLE}]",
                rule,
                f"an albedo of {albedo.max():.3g} at normal incidence",
                cure,
            )
        )
    names = (
        tuple(map(str, arrays["names"]))
        if "names" in arrays
        else tuple(f"material{i}" for i in range(len(brdf)))
    )
    disc = float(arrays.get("disc_angular_radius", 0.0))
    return Dictionary(
        names,
        table,
        DEFAULT_GRID,
        path.name,
        disc,
        tuple(origin for _, origin in resampled),
    )


def write_tables(
    path: str | Path, dictionary: Dictionary, **more: NDArray[Any]
) -> None:
    """Write a file for `read_tables`, with `more` arrays."""
    grid = dictionary.grid
    arrays: dict[str, Any] = {
        "names": np.array(dictionary.names, dtype=str),
        TABLE: np.moveaxis(dictionary.table, -1, 0),
        "theta_h": grid.theta_h,
        "theta_d": grid.theta_d,
        "phi_d": grid.phi_d,
        "units": np.array(UNITS[0]),
        "disc_angular_radius": np.array(dictionary.disc_angular_radius),
    }
    with private_file(path).open("wb") as stream:
        np.savez_compressed(stream, **(arrays | more))


def _load(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as data, np.load(data, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        rule = "must be a folder of MERL .binary files or an .npz file of BRDF tables"
        raise InputError(
            Fault(
                str(path), rule, str(error.strerror or "another file"), "check the path"
            )
        ) from None
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile):
        cure = "write it with skindb.reflectance.table_file.write_tables or numpy.savez"
        raise InputError(
            Fault(
                str(path), "must be an .npz file of plain arrays", "another file", cure
            )
        ) from None
    missing = [name for name in (TABLE, *NODES) if name not in arrays]
    if missing:
        rule = f"must contain {TABLE} and its nodes {', '.join(NODES)}"
        fault = f"no {', '.join(missing)}"
        raise InputError(Fault(str(path), rule, fault, "add them, in sr^-1 and rad"))
    wrong = [name for name in (TABLE, *NODES) if arrays[name].dtype.kind not in "fiu"]
    if wrong:
        raise InputError(
            Fault(
                str(path),
                "tables and nodes must be real numbers",
                f"others in {', '.join(wrong)}",
            )
        )
    return arrays | {name: arrays[name].astype(np.float64) for name in NODES}


def _channel_mean(one: NDArray[Any]) -> Array:
    """Mean over channels of one material (theta_h, theta_d, phi_d) [, RGB]; NaN where
    any channel is NaN.

    Materials are processed one at a time, as all of them take gigabytes.
    """
    grey = one.astype(np.float64)
    return np.asarray(grey.mean(axis=-1) if grey.ndim == 4 else grey)


def _node_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    faults = []
    for name, minimum in zip(NODES, (2, 2, 1), strict=True):
        nodes = arrays[name]
        place = f"{path}[{name}]"
        if nodes.ndim != 1 or len(nodes) < minimum:
            rule = f"must be a one-dimensional array of at least {minimum} nodes"
            faults.append(
                Fault(place, rule, f"the shape {nodes.shape}", "add the nodes")
            )
        elif not (np.diff(nodes) > 0).all():
            cure = "sort nodes and table, and remove repeated nodes"
            faults.append(
                Fault(
                    place,
                    "nodes must be in strictly ascending order",
                    "another order",
                    cure,
                )
            )
        else:
            faults += _range_faults(name, nodes, place)
    return faults


def _shape_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    brdf = arrays[TABLE]
    lengths = tuple(arrays[name].size for name in NODES)
    if (
        brdf.ndim not in (4, 5)
        or brdf.shape[1:4] != lengths
        or brdf.shape[4:] not in ((), (3,))
        or not len(brdf)
    ):
        rule = (
            f"must have the shape (materials, {', '.join(map(str, lengths))}), or with "
            "RGB (..., 3)"
        )
        cure = "transpose it, or correct the nodes"
        return [Fault(f"{path}[{TABLE}]", rule, str(brdf.shape), cure)]
    names = (
        [str(name) for name in np.atleast_1d(arrays["names"])]
        if "names" in arrays
        else []
    )
    if "names" in arrays and (len(names) != len(brdf) or len(set(names)) != len(brdf)):
        counts = f"{len(names)} names, {len(set(names))} of them different"
        return [
            Fault(
                f"{path}[names]",
                f"{len(brdf)} materials must have as many different names",
                counts,
            )
        ]
    return []


def _range_faults(name: str, nodes: Array, where: str) -> list[Fault]:
    """Faults of nodes that are not in rad or do not span their axis; the outermost
    value is used beyond them.
    """
    low = float(nodes[0])
    high = float(nodes[-1])
    if high > 2 * np.pi:
        return [
            Fault(
                where,
                "angles must be in rad",
                f"{high:g}",
                "convert them with numpy.radians",
            )
        ]
    if name == "phi_d":
        gap = float(np.diff(nodes, append=nodes[0] + np.pi).max())
        if low < 0 or high > np.pi - 1e-9:
            cure = (
                "average both halves, as a reciprocal isotropic BRDF has period pi, "
                "and omit the end"
            )
            return [
                Fault(where, "nodes must lie in [0, pi)", f"[{low:g}, {high:g}]", cure)
            ]
        if gap > np.pi / 2 + 1e-9 and len(nodes) > 1:
            rule = (
                "neighbouring nodes must be at most pi/2 apart, also across the end of "
                "the period"
            )
            return [Fault(where, rule, f"a gap of {gap:.3g}", "add nodes")]
    elif low < 0 or high > np.pi / 2 + 1e-6 or low > 0.2 or high < np.pi / 2 - 0.2:
        rule = "nodes must extend from 0 to pi/2 rad, with at most 0.2 missing at either end"
        return [
            Fault(
                where,
                rule,
                f"[{low:g}, {high:g}]",
                "add nodes, with NaN where nothing was measured",
            )
        ]
    return []


def _unit_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    faults = []
    if "units" in arrays and str(arrays["units"]) not in UNITS:
        unit = str(arrays["units"])
        faults.append(
            Fault(
                f"{path}[units]",
                "the unit of a BRDF must be sr-1",
                unit,
                "convert the table",
            )
        )
    disc = arrays.get("disc_angular_radius", np.zeros(()))
    if disc.shape != () or disc.dtype.kind not in "fiu" or not 0 <= disc < 0.5:
        rule = "must be one angle from 0 to 0.5 rad"
        cure = "omit it for tables of point lights"
        faults.append(Fault(f"{path}[disc_angular_radius]", rule, str(disc), cure))
    return faults


def _value_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    brdf = arrays[TABLE]
    place = f"{path}[{TABLE}]"
    faults = []
    if np.isinf(brdf).any():
        counts = f"{np.isinf(brdf).sum()} infinite ones"
        cure = "replace them by NaN"
        faults.append(Fault(place, "values must be finite or NaN", counts, cure))
    if (brdf < 0).any():
        cure = "use NaN where nothing was measured, and 0 where no light is reflected"
        faults.append(
            Fault(
                place,
                "a BRDF must not be negative",
                f"{(brdf < 0).sum()} values below 0",
                cure,
            )
        )
    nodes = arrays["theta_h"], arrays["theta_d"], arrays["phi_d"]
    holes = np.array(
        [
            hole_fraction(_channel_mean(brdf_of_material), nodes)
            for brdf_of_material in brdf
        ]
    )
    if (holes > MAX_HOLE_FRACTION).any():
        rule = (
            f"at most {MAX_HOLE_FRACTION:.0%} of the nodes above the horizon may be NaN"
        )
        counts = f"{holes.max():.0%} in material {int(holes.argmax())}"
        faults.append(
            Fault(
                place, rule, counts, "measure more directions, or remove the material"
            )
        )
    return faults

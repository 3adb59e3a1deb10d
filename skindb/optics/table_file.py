"""Tables of one's own measured BRDFs in an .npz."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb._types import Array
from skindb.errors import Fault, InputError
from skindb.optics.brdf_table import DEFAULT_GRID, directional_albedo
from skindb.optics.dictionary import Dictionary
from skindb.optics.resample import hole_fraction, on_grid

TABLE, NODES = "basis_brdf", ("theta_h", "theta_d", "phi_d")
UNITS = ("sr-1", "sr^-1", "1/sr")
MAX_HOLE_FRACTION = 0.5  # of the nodes above the horizon; beyond it a table is mostly guessed


def read_tables(path: str | Path) -> Dictionary:
    """Tables of one's own, resampled to the default grid.

    Parameters
    ----------
    path
        An .npz of `basis_brdf` (material, theta_h, theta_d, phi_d) or the same with RGB last, sr^-1, NaN where nothing
        was measured; its nodes `theta_h`, `theta_d` in [0, pi/2] and `phi_d` in [0, pi), rad, ascending; and if wanted
        `names` (material,), `units`, and `disc_angular_radius` [rad] of a light the tables are averaged over.
        `bases.npz` of an export is such a file, `write_tables` writes one.

    Raises
    ------
    InputError
        With every fault of the file.
    """
    path = Path(path)
    arrays = _load(path)
    faults = [*_node_faults(path, arrays), *_shape_faults(path, arrays), *_unit_faults(path, arrays)]
    faults = faults or _value_faults(path, arrays)
    if faults:
        raise InputError(faults)
    brdf, nodes = arrays[TABLE], (arrays["theta_h"], arrays["theta_d"], arrays["phi_d"])
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    made = [on_grid(_grey(one), nodes, "a file of tables", found) for one in brdf]
    table = np.stack([table for table, _ in made], axis=-1)
    albedo = directional_albedo(table, 1.0)[0]
    if albedo.max() > 2:  # beyond any error of a measurement
        rule, cure = "a surface reflects at most the light it gets", "give values in sr^-1"
        raise InputError(Fault(f"{path}[{TABLE}]", rule, f"{albedo.max():.3g} times that at normal incidence", cure))
    names = tuple(map(str, arrays["names"])) if "names" in arrays else tuple(f"material{i}" for i in range(len(brdf)))
    disc = float(arrays.get("disc_angular_radius", 0.0))
    return Dictionary(names, table, DEFAULT_GRID, path.name, disc, tuple(origin for _, origin in made))


def write_tables(path: str | Path, dictionary: Dictionary, **more: NDArray[Any]) -> None:
    """Write what `read_tables` reads, and `more` arrays beside."""
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
    np.savez_compressed(path, **(arrays | more))


def _load(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as data, np.load(data, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        rule = "measured BRDFs are a folder of MERL .binary files or an .npz of tables"
        raise InputError(Fault(str(path), rule, str(error.strerror or "another file"), "name one of them")) from None
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile):
        cure = "write it with skindb.optics.table_file.write_tables or numpy.savez"
        raise InputError(Fault(str(path), "is an .npz of plain arrays", "another file", cure)) from None
    lost = [name for name in (TABLE, *NODES) if name not in arrays]
    if lost:
        rule, found = f"a file of tables holds {TABLE} and its nodes {', '.join(NODES)}", f"no {', '.join(lost)}"
        raise InputError(Fault(str(path), rule, found, "add them, rad and sr^-1"))
    wrong = [name for name in (TABLE, *NODES) if arrays[name].dtype.kind not in "fiu"]
    if wrong:
        raise InputError(Fault(str(path), "tables and nodes are real numbers", f"others in {', '.join(wrong)}"))
    return arrays | {name: arrays[name].astype(np.float64) for name in NODES}


def _grey(one: NDArray[Any]) -> Array:
    """One material (theta_h, theta_d, phi_d) [, RGB]; NaN where a channel is. One by one: all at once are gigabytes."""
    grey = one.astype(np.float64)
    return np.asarray(grey.mean(axis=-1) if grey.ndim == 4 else grey)


def _node_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    faults = []
    for name, least in zip(NODES, (2, 2, 1), strict=True):
        nodes, where = arrays[name], f"{path}[{name}]"
        if nodes.ndim != 1 or len(nodes) < least:
            faults.append(Fault(where, f"is a row of at least {least} nodes", f"shape {nodes.shape}", "add the nodes"))
        elif not (np.diff(nodes) > 0).all():
            faults.append(Fault(where, "nodes ascend", "some that do not", "sort them and the table, without repeats"))
        else:
            faults += _range_faults(name, nodes, where)
    return faults


def _shape_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    brdf, lengths = arrays[TABLE], tuple(arrays[name].size for name in NODES)
    if brdf.ndim not in (4, 5) or brdf.shape[1:4] != lengths or brdf.shape[4:] not in ((), (3,)) or not len(brdf):
        rule = f"has the shape (materials, {', '.join(map(str, lengths))}), with RGB (..., 3)"
        cure = "transpose it, or give the nodes it lacks"
        return [Fault(f"{path}[{TABLE}]", rule, str(brdf.shape), cure)]
    names = [str(name) for name in np.atleast_1d(arrays["names"])] if "names" in arrays else []
    if "names" in arrays and (len(names) != len(brdf) or len(set(names)) != len(brdf)):
        found = f"{len(names)}, {len(set(names))} of them different"
        return [Fault(f"{path}[names]", f"{len(brdf)} materials have as many different names", found)]
    return []


def _range_faults(name: str, nodes: Array, where: str) -> list[Fault]:
    """Nodes in rad that span their axis: what lies beyond the outermost is their value."""
    low, high = float(nodes[0]), float(nodes[-1])
    if high > 2 * np.pi:
        return [Fault(where, "angles are in rad", f"{high:g}", "convert them with numpy.radians")]
    if name == "phi_d":
        gap = float(np.diff(nodes, append=nodes[0] + np.pi).max())
        if low < 0 or high > np.pi - 1e-9:
            cure = "a reciprocal isotropic BRDF has period pi: average both halves, leave out the end"
            return [Fault(where, "lies in [0, pi)", f"[{low:g}, {high:g}]", cure)]
        if gap > np.pi / 2 + 1e-9 and len(nodes) > 1:
            return [Fault(where, "nodes are at most pi/2 apart, round the period", f"a gap of {gap:.3g}", "add nodes")]
    elif low < 0 or high > np.pi / 2 + 1e-6 or low > 0.2 or high < np.pi / 2 - 0.2:
        rule, cure = "runs from 0 to pi/2 rad, open ends of 0.2 at most", "add nodes, with NaN where nothing is known"
        return [Fault(where, rule, f"[{low:g}, {high:g}]", cure)]
    return []


def _unit_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    faults = []
    if "units" in arrays and str(arrays["units"]) not in UNITS:
        found = str(arrays["units"])
        faults.append(Fault(f"{path}[units]", "a BRDF is in sr-1", found, "convert the table"))
    disc = arrays.get("disc_angular_radius", np.zeros(()))
    if disc.shape != () or disc.dtype.kind not in "fiu" or not 0 <= disc < 0.5:
        rule, cure = "is one angle in rad from 0 to 0.5", "leave it out for tables under point lights"
        faults.append(Fault(f"{path}[disc_angular_radius]", rule, str(disc), cure))
    return faults


def _value_faults(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[Fault]:
    brdf, where = arrays[TABLE], f"{path}[{TABLE}]"
    faults = []
    if np.isinf(brdf).any():
        faults.append(Fault(where, "values are finite or NaN", f"{np.isinf(brdf).sum()} infinite", "make them NaN"))
    if (brdf < 0).any():
        cure = "NaN where nothing was measured, 0 where no light comes back"
        faults.append(Fault(where, "a BRDF is not negative", f"{(brdf < 0).sum()} values below 0", cure))
    nodes = arrays["theta_h"], arrays["theta_d"], arrays["phi_d"]
    holes = np.array([hole_fraction(_grey(one), nodes) for one in brdf])
    if (holes > MAX_HOLE_FRACTION).any():
        rule = f"at most {MAX_HOLE_FRACTION:.0%} of the nodes above the horizon are NaN"
        found = f"{holes.max():.0%} in material {int(holes.argmax())}"
        faults.append(Fault(where, rule, found, "measure more, or leave the material out"))
    return faults

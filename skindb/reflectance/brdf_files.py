"""Files of measured BRDFs: .npz files of tables, and folders of MERL binaries (Matusik et
al. 2003). Their values are resampled to the default grid.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from skindb.errors import Fault, InputError, input_error, require, require_none
from skindb.files import file_digest, private_file
from skindb.optics.angles import half_difference
from skindb.reflectance.dictionary import (
    Dictionary,
    Origin,
    sample_pairs,
    weighted_error,
)
from skindb.reflectance.tables import (
    ANGLES,
    DEFAULT_GRID,
    Table,
    directional_albedo,
    lookup,
)
from skindb.types import AnyArray, Array, float64

TABLE = "basis_brdf"
NODES = ANGLES
UNITS = ("sr-1", "sr^-1", "1/sr")
# of the nodes above the horizon, above which a table is mostly extrapolated
MAX_HOLE_FRACTION = 0.5
SHAPE = (90, 90, 180)  # theta_h (quadratic), theta_d, phi_d
SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
Nodes = tuple[Array, Array, Array]  # theta_h, theta_d, phi_d [rad]


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
    faults = [*_layout_faults(arrays)] or [*_value_faults(arrays)]
    if faults:
        raise InputError([Fault(f"{path}[{name}]", *fault) for name, *fault in faults])
    brdf = arrays[TABLE]
    nodes = (arrays["theta_h"], arrays["theta_d"], arrays["phi_d"])
    digest = file_digest(path)
    resampled = [
        to_default_grid(_channel_mean(brdf_of_material), nodes, digest)
        for brdf_of_material in brdf
    ]
    table = np.stack([table for table, _ in resampled], axis=-1)
    albedo = directional_albedo(table, 1.0)[0]
    require(
        albedo.max() <= 2,  # more than an error of measurement explains
        f"{path}[{TABLE}]",
        "a surface must not reflect more light than it receives",
        f"an albedo of {albedo.max():.3g} at normal incidence",
        "provide values in sr^-1",
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


def write_tables(path: str | Path, dictionary: Dictionary, **extra: AnyArray) -> None:
    """Write a file for `read_tables`, with `extra` arrays."""
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
        np.savez_compressed(stream, **(arrays | extra))


def _load(path: Path) -> dict[str, AnyArray]:
    try:
        with path.open("rb") as data, np.load(data, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        rule = "must be a folder of MERL .binary files or an .npz file of BRDF tables"
        raise input_error(
            str(path), rule, str(error.strerror or "another file"), "check the path"
        ) from None
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile):
        raise input_error(
            str(path),
            "must be an .npz file of plain arrays",
            "another file",
            "write it with skindb.reflectance.brdf_files.write_tables or numpy.savez",
        ) from None
    missing = [name for name in (TABLE, *NODES) if name not in arrays]
    require(
        not missing,
        str(path),
        f"must contain {TABLE} and its nodes {', '.join(NODES)}",
        f"no {', '.join(missing)}",
        "add them, in sr^-1 and rad",
    )
    wrong = [name for name in (TABLE, *NODES) if arrays[name].dtype.kind not in "fiu"]
    require(
        not wrong,
        str(path),
        "tables and nodes must be real numbers",
        f"others in {', '.join(wrong)}",
    )
    return arrays | {name: float64(arrays[name]) for name in NODES}


def _channel_mean(brdf: AnyArray) -> Array:
    """Mean over channels of one material (theta_h, theta_d, phi_d) [, RGB]; NaN where
    any channel is NaN.

    Materials are processed one at a time, as all of them take gigabytes.
    """
    grey = float64(brdf)
    return grey.mean(axis=-1) if grey.ndim == 4 else grey


Faults = Iterator[tuple[str, ...]]  # array, rule, what was found, cure if there is one


def _layout_faults(arrays: Mapping[str, AnyArray]) -> Faults:
    """Faults of nodes, shapes and units."""
    for name in NODES:
        for fault in _node_faults(name, arrays[name]):
            yield name, *fault
    brdf = arrays[TABLE]
    lengths = tuple(arrays[name].size for name in NODES)
    channels = brdf.shape[4:] in ((), (3,))
    if brdf.ndim < 4 or brdf.shape[1:4] != lengths or not channels or not len(brdf):
        rule = (
            f"must have the shape (materials, {', '.join(map(str, lengths))}), or with "
            "RGB (..., 3)"
        )
        yield TABLE, rule, str(brdf.shape), "transpose it, or correct the nodes"
    elif "names" in arrays:
        names = [str(name) for name in np.atleast_1d(arrays["names"])]
        different = len(set(names))
        if not len(names) == different == len(brdf):
            rule = f"{len(brdf)} materials must have as many different names"
            yield "names", rule, f"{len(names)} names, {different} of them different"
    units = str(arrays.get("units", UNITS[0]))
    if units not in UNITS:
        yield "units", "the unit of a BRDF must be sr-1", units, "convert the table"
    disc = arrays.get("disc_angular_radius", np.zeros(()))
    if disc.shape != () or disc.dtype.kind not in "fiu" or not 0 <= disc < 0.5:
        rule = "must be one angle from 0 to 0.5 rad"
        cure = "omit it for tables of point lights"
        yield "disc_angular_radius", rule, str(disc), cure


def _node_faults(name: str, nodes: Array) -> Faults:
    """Faults of nodes that are not in rad or do not span their axis; the outermost
    value is used beyond them.
    """
    minimum = 1 if name == "phi_d" else 2
    if nodes.ndim != 1 or len(nodes) < minimum:
        rule = f"must be a one-dimensional array of at least {minimum} nodes"
        yield rule, f"the shape {nodes.shape}", "add the nodes"
        return
    low = float(nodes[0])
    high = float(nodes[-1])
    extent = f"[{low:g}, {high:g}]"
    if not (np.diff(nodes) > 0).all():
        cure = "sort nodes and table, and remove repeated nodes"
        yield "nodes must be in strictly ascending order", "another order", cure
    elif high > 2 * np.pi:
        yield "angles must be in rad", f"{high:g}", "convert them with numpy.radians"
    elif name == "phi_d" and (low < 0 or high > np.pi - 1e-9):
        cure = (
            "average both halves, as a reciprocal isotropic BRDF has period pi, "
            "and omit the end"
        )
        yield "nodes must lie in [0, pi)", extent, cure
    elif name == "phi_d":
        gap = float(np.diff(nodes, append=nodes[0] + np.pi).max())
        if gap > np.pi / 2 + 1e-9 and len(nodes) > 1:
            rule = (
                "neighbouring nodes must be at most pi/2 apart, also across the end of "
                "the period"
            )
            yield rule, f"a gap of {gap:.3g}", "add nodes"
    elif low < 0 or high > np.pi / 2 + 1e-6 or low > 0.2 or high < np.pi / 2 - 0.2:
        rule = "nodes must extend from 0 to pi/2 rad, with at most 0.2 missing at either end"
        yield rule, extent, "add nodes, with NaN where nothing was measured"


def _value_faults(arrays: Mapping[str, AnyArray]) -> Faults:
    brdf = arrays[TABLE]
    infinite = int(np.isinf(brdf).sum())
    negative = int((brdf < 0).sum())
    if infinite:
        rule = "values must be finite or NaN"
        yield TABLE, rule, f"{infinite} infinite ones", "replace them by NaN"
    if negative:
        cure = "use NaN where nothing was measured, and 0 where no light is reflected"
        yield TABLE, "a BRDF must not be negative", f"{negative} values below 0", cure
    nodes = arrays["theta_h"], arrays["theta_d"], arrays["phi_d"]
    holes = np.array([hole_fraction(_channel_mean(one), nodes) for one in brdf])
    if (holes > MAX_HOLE_FRACTION).any():
        rule = (
            f"at most {MAX_HOLE_FRACTION:.0%} of the nodes above the horizon may be NaN"
        )
        counts = f"{holes.max():.0%} in material {int(holes.argmax())}"
        yield TABLE, rule, counts, "measure more directions, or remove the material"


def read_merl(path: str | Path) -> tuple[Array, int]:
    """Read one material.

    Returns
    -------
    table, holes
        (90, 90, 180, 3) sr^-1 over theta_h (bins quadratic), theta_d and phi_d in [0,
        pi), and the number of cells with a negative channel. These were not measured
        and are NaN in every channel.

    Notes
    -----
    The reader that MERL provides takes bin floor(x). The value of bin i is thus for [i,
    i + 1), and its centre is i + 1/2.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise input_error(
            str(path),
            "must be a readable file",
            str(error.strerror),
            "choose a MERL .binary file",
        ) from None
    dims = tuple(np.frombuffer(data[: min(len(data), 12) // 4 * 4], "<i4").tolist())
    want = 12 + 8 * 3 * int(np.prod(SHAPE))
    require(
        dims == SHAPE and len(data) == want,
        str(path),
        f"a MERL binary must have the header {SHAPE} and {want} bytes",
        f"the header {dims} and {len(data)} bytes",
        "download it again",
    )
    values = np.frombuffer(data[12:], "<f8").reshape(3, *SHAPE)
    wrong = int((~np.isfinite(values)).sum())
    require(
        not wrong,
        str(path),
        "values must be finite",
        f"{wrong} that are not",
        "download it again",
    )
    table = np.moveaxis(values, 0, -1) * SCALE
    hole = np.any(table < 0, axis=-1)
    require(
        not hole.all(),
        str(path),
        "some cells must be measured",
        "only negative values",
        "download it again",
    )
    return np.where(hole[..., None], np.nan, table), int(hole.sum())


def write_merl(path: str | Path, table: Array) -> None:
    """Write a table (90, 90, 180, 3) in sr^-1, whose values must be finite and non-negative."""
    table = float64(table)
    wrong = int((~(np.isfinite(table) & (table >= 0))).sum())
    if table.shape != (*SHAPE, 3) or wrong:
        content = f"the shape {table.shape} and {wrong} other values"
        raise ValueError(
            f"a MERL table must have the shape {(*SHAPE, 3)}, finite and "
            f"non-negative; found {content}"
        )
    values = np.ascontiguousarray(np.moveaxis(table / SCALE, -1, 0))
    private_file(path).write_bytes(
        np.array(SHAPE, "<i4").tobytes() + values.astype("<f8").tobytes()
    )


def read_merl_folder(path: str | Path) -> Dictionary:
    """Read every `*.binary` file of a folder, in the order of their names, resampled to
    the default grid.

    Cells without a measurement take the value at the next smaller theta_d.

    Raises
    ------
    InputError
        With the faults of all damaged files.
    """
    files = sorted(Path(path).glob("*.binary"))
    require(
        files,
        str(path),
        "the folder must contain MERL .binary files",
        "none",
        "choose their folder, or an .npz file of tables",
    )
    # centres of bins; theta_h is quadratic
    h, d, p = ((np.arange(n) + 0.5) / n for n in SHAPE)
    nodes = (h**2 * np.pi / 2, d * np.pi / 2, p * np.pi)
    tables = []
    origins = []
    faults: list[Fault] = []
    for file in files:
        try:
            brdf = read_merl(file)[0].mean(axis=-1)
            digest = file_digest(file)
            table, origin = to_default_grid(brdf, nodes, digest)
        except InputError as error:
            faults.extend(error.faults)
        else:
            tables.append(table)
            origins.append(origin)
    require_none(faults)
    names = tuple(file.stem for file in files)
    return Dictionary(
        names,
        np.stack(tables, axis=-1),
        DEFAULT_GRID,
        Path(path).resolve().name,
        origins=tuple(origins),
    )


def to_default_grid(brdf: Array, nodes: Nodes, sha256: str) -> tuple[Table, Origin]:
    """One material (theta_h, theta_d, phi_d) on the default grid, and its origin with
    the error of resampling.
    """
    table = to_grid(fill_holes(brdf), nodes)
    return table, Origin(
        sha256, hole_fraction(brdf, nodes), _resampling_error(brdf, nodes, table)
    )


def hole_fraction(brdf: Array, nodes: Nodes) -> float:
    """Fraction of NaN among the nodes with both directions above the horizon."""
    theta_h, theta_d, phi_d = np.ix_(*nodes)
    # cosine
    smaller = np.cos(theta_h) * np.cos(theta_d) - np.abs(
        np.sin(theta_h) * np.sin(theta_d) * np.cos(phi_d)
    )
    return float(np.isnan(brdf[smaller > 1e-9]).mean())


def to_grid(brdf: Array, nodes: Nodes) -> Table:
    """Interpolate values (nh, nd, np) to the default grid, linearly in sqrt(theta_h),
    theta_d and phi_d.
    """
    grid = DEFAULT_GRID
    axes = (grid.theta_h, grid.theta_d, grid.phi_d)
    same = zip(nodes, axes, strict=True)
    if all(len(a) == len(b) and np.allclose(a, b, rtol=0, atol=1e-6) for a, b in same):
        return brdf.astype(np.float32)
    # constant beyond the nodes
    inside = [np.clip(a, b[0], b[-1]) for a, b in zip(axes[:2], nodes, strict=False)]
    angles = np.meshgrid(*inside, grid.phi_d, indexing="ij")
    table = _interpolated(brdf, nodes, *angles)
    # phi_d is undefined where the half vector is the normal
    table[0] = table[0].mean(axis=-1, keepdims=True)
    return table.astype(np.float32)


def _interpolated(
    brdf: Array, nodes: Nodes, theta_h: Array, theta_d: Array, phi_d: Array
) -> Array:
    """Values at angles of one shape; NaN beyond the nodes of theta_h and theta_d."""
    n = len(nodes[2])
    # one node more on both sides of the period pi
    phi = np.concatenate([[nodes[2][-1] - np.pi], nodes[2], [nodes[2][0] + np.pi]])
    axes = (np.sqrt(nodes[0]), nodes[1], phi)
    values = brdf[:, :, np.arange(-1, n + 1) % n]
    interpolator = RegularGridInterpolator(axes, values, bounds_error=False)
    return interpolator((np.sqrt(theta_h), theta_d, phi_d))


def _resampling_error(brdf: Array, nodes: Nodes, table: Table) -> float:
    """Error of the table against trilinear interpolation of the measured nodes, where
    all eight were measured.
    """
    wi, wo = sample_pairs()
    th, td, pd = half_difference(wi, wo)
    values = _interpolated(brdf, nodes, th, td, pd)
    finite = np.isfinite(values)
    if not finite.any():
        return float("nan")
    values_of_table = lookup(table[..., None], th[finite], td[finite], pd[finite])
    return float(
        weighted_error(values_of_table, values[finite, None], wi[finite], wo[finite])[0]
    )


def fill_holes(brdf: Array) -> Array:
    """Fill holes of (nh, nd, np), which are NaN: below the horizon or unmeasured.

    They take the value of the nearest smaller theta_d, else of the nearest larger
    theta_d, else of the neighbour in theta_h, else in phi_d. Zeros instead would darken
    adjacent cells by interpolation.
    """
    for axis, backwards in (
        (1, False),
        (1, True),
        (0, False),
        (0, True),
        (2, False),
        (2, True),
    ):
        turned = np.flip(brdf, axis) if backwards else brdf
        place = np.arange(turned.shape[axis]).reshape(
            [-1 if a == axis else 1 for a in range(3)]
        )
        nearest = np.maximum.accumulate(
            np.where(np.isfinite(turned), place, 0), axis=axis
        )
        turned = np.take_along_axis(turned, nearest, axis=axis)
        brdf = np.flip(turned, axis) if backwards else turned
    return brdf

"""Export of a model as a bundle: maps, bases, glTF, USD and Mitsuba scenes, with a manifest and a
README.txt.
"""

import hashlib
import json
import shutil
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb import __version__
from skindb.errors import input_error, require
from skindb.export.gltf import export_gltf
from skindb.export.inputs import describe_edit
from skindb.export.maps import RGB, TextureMap, texture_maps
from skindb.export.scenes import (
    MATERIAL,
    MESH,
    PROGRAM,
    STAGE,
    export_mitsuba,
    export_usd,
)
from skindb.export.textures import skin_of
from skindb.files import Json, filled_template, make_private, plain, private_file
from skindb.reflectance.brdf_files import write_merl, write_tables
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.kinds import as_mixture
from skindb.reflectance.tables import TableGrid, kernel_tables, lookup
from skindb.render.image import write_exr
from skindb.schema import (
    VARIABLES,
    FitStatus,
    ProbeStatus,
    Use,
    fitted_of,
    names_of,
    variables,
)
from skindb.schema.consent import require_consent
from skindb.types import Float32, Float64, Progress, float64, silent

PROVENANCE = (
    "schema_version",
    "software_version",
    "command",
    "parameters",
    "seeds",
    "inputs",
    "subject",
    "condition",
    "session",
    "mode",
    "rank",
    "k",
    "eta",
    "held_out_lights",
    "held_out_cameras",
    "generation",
    "edit",
    "edit_distance",
)
# standard_error is from the errors of the fibres; total_error includes the error of the
# model of the profile
SITE_FIGURES = {
    "sigma_tr": variables.SITE_SIGMA_TR,
    "standard_error": variables.SITE_SIGMA_TR_ERROR,
    "total_error": variables.SITE_SIGMA_TR_TOTAL_ERROR,
}
# what the files beside maps and bases hold, and their units
SCENES = {
    "model.glb": (
        "glTF 2.0: mesh, uv, shading normals as a texture, and a metallic-roughness "
        "approximation of the material",
        "m",
    ),
    f"usd/{STAGE}": (
        "USD scene: mesh, and an OpenPBR material (MaterialX) with light under the skin",
        "mm",
    ),
    f"usd/{MATERIAL}": (
        "only the OpenPBR material, for programs that read MaterialX; lengths in mm",
        "mm",
    ),
    "usd/baseColor.png": ("base colour, sRGB", "1"),
    "usd/roughness.png": ("perceptual roughness, linear", "1"),
    "usd/specularFactor.png": ("factor on all reflection, linear", "1"),
    "usd/normal.png": (
        "normals in tangent space, times 0.5 plus 0.5, +y towards the top of the texture",
        "1",
    ),
    f"mitsuba/{MESH}": (
        "mesh for Mitsuba: positions [mm], shading normals, uv",
        "mm",
    ),
    f"mitsuba/{PROGRAM}": (
        "Mitsuba 3: the exact BRDFs as a BSDF, and a scene, which python skin.py "
        "picture.exr renders",
        "mm",
    ),
}
CONVENTIONS = {
    "length": "mm in maps and tables, metres in model.glb",
    "frame": "right-handed, +x to the subject's left, +y up, +z out of the face",
    "colour": "scene-linear RGB, Rec. 709 primaries, D65",
    "texture": (
        "v = 0 at the top row; texel (i, j) has its centre at v = (i + 0.5)/height, u "
        "= (j + 0.5)/width"
    ),
    "reflectance": (
        "f_r = F_t(i) F_t(o) albedo / pi + sum over k of weight_k b_k(theta_h, "
        "theta_d, phi_d); albedo is R_d plus even_reflection, the fraction that the "
        "surface reflects evenly and without colour"
    ),
    "fresnel": "exact, unpolarised, refractive index eta; the bases contain their own Fresnel term",
    "angles": (
        "Rusinkiewicz half/difference; tables: nodes uniform in sqrt(theta_h), theta_d "
        "and phi_d (period pi)"
    ),
    "light_disc": "bases.npz and the MERL files are averaged over the round lights of the dome, "
    "whose angular radius "
    "seen from the skin is disc_angular_radius [rad]. Use them with point lights, "
    "because disc lights would widen "
    "highlights twice. If it is 0, the BRDFs are for point lights, as measured",
    "translucency": "translucency_sites: sigma_tr [1/mm] of R, G, B at the sites of the probe, its "
    "standard_error from "
    "the fibres, its total_error, which includes that of the model, and the status "
    "of the fit. maps/translucency.exr "
    "interpolates 1 / sigma_tr between the sites; its error there is unknown",
    "merl": "90 x 90 x 180 bins, values at bin centres, the three channels equal",
}


Files = dict[str, Json]  # path -> what it holds, units, and more


def export_bundle(
    model: xr.DataTree,
    out: str | Path,
    *,
    size: int | None = None,
    merl: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Write the folder `out`: `maps/*.exr`, `bases/`, `model.glb`, manifest.json and README.txt.

    Parameters
    ----------
    model
        Version of kind "model" whose consent covers export.
    out
        Folder that does not exist or is empty. If the export fails, it is not created.
    size
        Texels along each side of the maps; default 1.5 texels per spacing of the
        surfels, rounded up to a power of two.
    merl
        Whether to write each component in the binary format of MERL too (35 MB each).
    progress
        Called with the stage, the steps done and the steps in all.

    Returns
    -------
    Path
        Path of the manifest.
    """
    require_consent(model.attrs, "export")
    model = as_mixture(model)
    target = Path(out).absolute()  # absolute, as "." has no name
    require(
        not target.exists() or (target.is_dir() and not any(target.iterdir())),
        str(target),
        "must be a new or empty folder",
        "files in it" if target.is_dir() else "a file",
        "choose another folder",
    )
    staged = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        make_private(staged)
    except OSError as error:
        content = error.strerror or str(error)
        raise input_error(
            str(target),
            "must be a folder that can be created",
            content,
            "choose another folder",
        ) from None
    try:
        described = _write_parts(model, staged, size, merl, progress or silent)
        manifest = _manifest(model, staged, described)
        text = json.dumps(plain(manifest), indent=1, allow_nan=False)
        private_file(staged / "manifest.json").write_text(text + "\n", encoding="utf-8")
        has_merl = any(name.endswith(".binary") for name in described)
        template = ("skindb.export", "README.txt.jinja")
        text = filled_template(*template, **manifest, has_merl=has_merl)
        private_file(staged / "README.txt").write_text(text, encoding="utf-8")
        if target.exists():
            target.rmdir()
        staged.rename(target)
    finally:
        shutil.rmtree(staged, ignore_errors=True)
    return target / "manifest.json"


def merl_table(table: Float32) -> Float64:
    """One component (nh, nd, np) resampled to the bin centres of MERL, (90, 90, 180,
    3), with equal channels.
    """
    h = (np.arange(90) + 0.5) ** 2 / 90**2 * np.pi / 2
    d = (np.arange(90) + 0.5) / 90 * np.pi / 2
    p = (np.arange(180) + 0.5) / 180 * np.pi
    values = lookup(table[..., None], *np.meshgrid(h, d, p, indexing="ij"))
    return np.repeat(float64(values), 3, axis=-1)


def _write_parts(
    model: xr.DataTree, folder: Path, size: int | None, merl: bool, report: Progress
) -> Files:
    """Write all files except the manifest; returns a description of each by its path."""
    report("maps", 0, 3)
    maps = texture_maps(model, size=size)
    files = _write_maps(maps, folder / "maps")
    path = maps.get("mean_free_path")
    longest = 0.0
    if path is not None and len(path.channels) == 3:
        longest = float(path.values.max())
    del path, maps  # large, and the textures need as much memory again
    report("bases", 1, 3)
    files |= _write_bases(model["basis"].to_dataset(), folder / "bases", merl)
    report("glTF", 2, 3)
    skin = skin_of(model, size=size)
    export_gltf(model, folder / "model.glb", skin=skin)
    export_usd(model, folder / "usd", skin, longest_path=longest)
    export_mitsuba(model, folder / "mitsuba")
    files |= {name: _held(*described) for name, described in SCENES.items()}
    files["model.glb"]["approximation_error"] = skin.error
    files[f"usd/{STAGE}"] |= {
        "approximation_error": skin.error_of_one_index,
        "approximation_error_of_preview": skin.error_of_preview,
    }
    report("done", 3, 3)
    return files


def _held(holds: str, units: str, **more: Any) -> Json:
    """Description of a file."""
    return {"holds": holds, "units": units, **more}


def _write_maps(maps: dict[str, TextureMap], folder: Path) -> Files:
    make_private(folder)
    files = {}
    for name, texture in maps.items():
        values = texture.values
        planes = dict(zip(texture.channels, np.moveaxis(values, -1, 0), strict=True))
        attributes = {"units": texture.units, "comments": texture.doc}
        attributes |= {key: CONVENTIONS[key] for key in ("frame", "colour", "texture")}
        write_exr(folder / f"{name}.exr", planes, attributes=attributes)
        files[f"maps/{name}.exr"] = _held(
            texture.doc,
            texture.units,
            channels=list(texture.channels),
            width=values.shape[1],
            height=values.shape[0],
        )
    return files


def _write_bases(basis: xr.Dataset, folder: Path, merl: bool) -> Files:
    make_private(folder)
    tables = kernel_tables(basis)
    count = tables.shape[-1]
    names = [f"component{k}" for k in range(count)]
    if "component" in basis.coords:
        names = [*map(str, basis["component"].values)]
    disc = float(basis[variables.DISC_ANGULAR_RADIUS])
    grid = TableGrid(*tables.shape[:3])
    dictionary = Dictionary(tuple(names), tables, grid, "basis", disc)
    arrays = {}
    if variables.BASIS_MIXTURE in basis:
        arrays[variables.BASIS_MIXTURE] = basis[variables.BASIS_MIXTURE].values
    if "dictionary" in basis.coords:
        arrays["dictionary_names"] = np.array([*map(str, basis["dictionary"].values)])
    write_tables(folder / "bases.npz", dictionary, **arrays)
    mixed = "mixtures of the measured BRDFs; " if arrays else ""
    text = (
        "basis_brdf (component, theta_h, theta_d, phi_d), its nodes [rad], "
        f"{mixed}skindb fit --dictionary reads it"
    )
    files = {"bases/bases.npz": _held(text, "sr-1")}
    for k in range(count if merl else 0):
        write_merl(folder / f"component_{k}.binary", merl_table(tables[..., k]))
        text = f"component {k}, MERL BRDF format"
        files[f"bases/component_{k}.binary"] = _held(text, "sr-1")
    return files


def _manifest(model: xr.DataTree, folder: Path, files: Files) -> Json:
    attrs = model.attrs
    fitted = fitted_of(model)
    return {
        "format": "skindb-bundle",
        "version": 1,
        "written_by": f"skindb {__version__}",
        "consent_scope": list(attrs["consent_scope"]),
        "may_be_published": "publish" in attrs["consent_scope"],
        "edited": describe_edit(attrs),
        "conventions": CONVENTIONS,
        "refractive_index": float(fitted[variables.REFRACTIVE_INDEX]),
        "disc_angular_radius": float(model["basis/disc_angular_radius"]),
        variables.EVEN_REFLECTION: float(fitted.get(variables.EVEN_REFLECTION, 0.0)),
        "provenance": {name: attrs[name] for name in PROVENANCE if name in attrs},
        "error": _errors(fitted),
        "missing": _missing(model, files),
        "translucency_sites": _sites(model),
        "files": {
            name: file | _fingerprint(folder / name) for name, file in files.items()
        },
    }


def _missing(model: xr.DataTree, files: Files) -> list[str]:
    """Parts of a complete bundle that this one lacks, with the reasons."""
    missing = []
    if "edit" in model.attrs:
        missing.append(
            "error, maps of errors, errors of translucency_sites: they describe the fit, "
            "which did not see the edited face"
        )
    channels = files.get("maps/translucency.exr", {}).get("channels", [])
    if lost := ", ".join(channel for channel in RGB if channel not in channels):
        text = "sigma_tr is unknown at all probe sites"
        missing.append(f"maps/translucency.exr: {lost}: {text}")
    return missing


def _errors(fitted: xr.Dataset) -> Json:
    """Median and 95 % quantile over fitted surfels of every quality measure, and the
    fraction of each status.
    """
    status = fitted[variables.FIT_STATUS].values
    fractions = {}
    for member in FitStatus:
        if fraction := float((status == member).mean()):
            about = {"fraction": fraction, "meaning": member.explanation}
            fractions[member.name.lower()] = about
    report = {"surfels": status.size, "status_fraction": fractions}
    for name in names_of(Use.EXPORTED):
        values = fitted[name].values if name in fitted else np.zeros(0)
        finite = values[np.isfinite(values)]
        if finite.size:
            report[name] = {
                "median": float(np.median(finite)),
                "quantile_95": float(np.quantile(finite, 0.95)),
                "units": VARIABLES[name].units,
                "meaning": VARIABLES[name].doc,
            }
    return report


def _sites(model: xr.DataTree) -> Json:
    """sigma_tr [mm^-1], its errors and its status per probe site and channel; empty
    without a probe.
    """
    if "translucency" not in model.children:
        return {}
    group = model["translucency"].to_dataset()
    have = {
        key: group[name].values for key, name in SITE_FIGURES.items() if name in group
    }
    if variables.SITE_STATUS in group:
        named = np.array([status.name.lower() for status in sorted(ProbeStatus)])
        have["status"] = named[group[variables.SITE_STATUS].values]
    return {
        str(site): {key: values[i] for key, values in have.items()}
        for i, site in enumerate(group["site"].values)
    }


def _fingerprint(path: Path) -> Json:
    with path.open("rb") as file:
        return {
            "sha256": hashlib.file_digest(file, "sha256").hexdigest(),
            "bytes": path.stat().st_size,
        }

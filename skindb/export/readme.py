"""The README.txt of a bundle: contents of the files, and instructions for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any

WIDTH = 100
MERL = "Renderers that read MERL binaries"
PROGRAMS = {
    "Blender (4.2 or later)": (
        "Import model.glb (File > Import > glTF 2.0), whose lengths are in metres; "
        "its textures are connected. In "
        "Cycles, it can be improved in three independent steps. Albedo: open "
        "maps/albedo.exr as an image texture with "
        "the colour space Linear Rec.709 and connect it to Base Color. Normals: "
        "open maps/normal_tangent.exr with the "
        "colour space Non-Color, multiply it by 0.5 and add 0.5 (Vector Math, "
        "Multiply Add), and connect it to the "
        "Color of the Normal Map node (Tangent Space). Light under the skin: set "
        "Subsurface Weight to 1, the method "
        "to Random Walk (Skin) and Subsurface Scale to 0.002, and connect "
        "maps/translucency.exr with the colour space "
        "Non-Color to Subsurface Radius. The scale contains 0.001 from mm to m and "
        "a factor of 2, with which the "
        "method spreads light as far as the dipole. usd/face.usda can be imported "
        "too, but Blender reads only its "
        "UsdPreviewSurface.",
    ),
    "Programs that read USD or MaterialX (Houdini, Omniverse, Arnold, Karma, ...)": (
        "Load usd/face.usda. It contains the mesh in mm (metersPerUnit = 0.001), "
        "an OpenPBR material with "
        "light under the skin, and a UsdPreviewSurface for viewers without "
        "MaterialX. usd/face.mtlx contains only the "
        "material. subsurface_radius is the longest mean free path in mm, and "
        "subsurface_radius_scale its ratio at "
        "each texel and channel. With the random walk of OpenPBR, light travels as "
        "far as by the dipole with the "
        "measured sigma_tr. Keep the folder maps beside the folder usd, because "
        "the mean free path is read from "
        "maps/mean_free_path.exr. For several faces in one scene, reference the "
        "files, and do not merge their layers.",
    ),
    "Mitsuba 3": (
        "Run python mitsuba/skin.py picture.exr, which requires the packages "
        "mitsuba and numpy, and for speed the "
        "library LLVM, version 17 or later. The program contains a BSDF of the "
        "exact measured BRDFs, mixed with the "
        "weights maps/weight_<k>.exr. You can import it into your own scenes. It "
        "does not include subsurface "
        "transport.",
    ),
    "Unreal Engine 5 (not tested by us)": (
        "Import model.glb (Interchange), which connects its textures. For light "
        "under the skin, choose the shading "
        "model Subsurface Profile. A profile has one mean free path for the whole "
        "material: a typical value of "
        "maps/mean_free_path.exr, divided by 10, because Unreal uses centimetres.",
    ),
    MERL: (
        "bases/component_<k>.binary are the components of the surface BRDF in the "
        "format of the MERL database. Mix "
        "them with the weights maps/weight_<k>.exr and add the diffuse term, see "
        "reflectance above.",
    ),
}


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 100_000 else f"{count / 1e3:.1f} kB"


def readme(manifest: Mapping[str, Any]) -> str:
    """Text of the README for a manifest."""
    parts = [
        "skindb bundle",
        "=============",
        "",
        *_paragraph(f"Written by {manifest['written_by']}. {_edited(manifest)}"),
    ]
    parts += ["", "Files", "-----", ""]
    for name, about in manifest["files"].items():
        parts += _item(
            name, f"{about['holds']} [{about['units']}], {_size(about['bytes'])}"
        )
    parts += ["", "Units, frames and colours", "-------------------------", ""]
    for name, text in manifest["conventions"].items():
        parts += _item(name, text)
    parts += ["", "Use in other programs", "---------------------", ""]
    has_merl = any(name.endswith(".binary") for name in manifest["files"])
    for name, (text,) in PROGRAMS.items():
        if name != MERL or has_merl:
            parts += [f"{name}:", *_paragraph(text), ""]
    parts += ["Errors", "------", "", *_errors(manifest)]
    return "\n".join(parts) + "\n"


def _edited(manifest: Mapping[str, Any]) -> str:
    edited = manifest["edited"]
    if not edited:
        return "The face is as measured."
    by = ", ".join(f"{name} {amount:g}" for name, amount in edited["by"].items())
    return f"The face was edited by {by}. {edited['consent']}"


def _errors(manifest: Mapping[str, Any]) -> list[str]:
    """Lines with the measured errors of the exports, and of the model itself."""
    error = manifest["files"]["model.glb"]["approximation_error"]
    lines = _item(
        "maps and bases",
        "the values of the model, in single or half precision; pictures rendered "
        "from maps of the default size differ "
        "from those of the model by about 1%",
    )
    lines += _item(
        "model.glb",
        "pictures of its material differ from those of the model by "
        f"{error['relative_rms']:.1%} (relative root mean "
        "square over lights and cameras in all directions), and in cube-root "
        "space, which is closer to perception, by "
        f"{error['relative_rms_perceptual']:.1%}; normals differ by "
        f"{error['normal_error_degrees']:.2f} degrees "
        "(median)",
    )
    usd = manifest["files"]["usd/face.usda"]
    error = usd["approximation_error"]
    preview = usd["approximation_error_of_preview"]
    lines += _item(
        "mitsuba/skin.py",
        (
            "pictures differ from those of skindb without subsurface transport by "
            "about 1%, because of the size of texels"
        ),
    )
    lines += _item(
        "indices of refraction",
        "refractive_index of manifest.json is that of the skin. ior in model.glb "
        "and specular_ior in usd only scale "
        "the fitted reflection at normal incidence, so they may be far from it",
    )
    lines += _item(
        "usd/face.usda",
        f"the same errors are {error['relative_rms']:.1%} and "
        f"{error['relative_rms_perceptual']:.1%}, computed with "
        "the equations of glTF and one index of refraction; implementations of "
        "OpenPBR differ in their layering. Those "
        f"of its UsdPreviewSurface are {preview['relative_rms']:.1%} and "
        f"{preview['relative_rms_perceptual']:.1%}",
    )
    for name, about in manifest["error"].items():
        if isinstance(about, Mapping) and "median" in about:
            text = (
                f"{about['meaning']}: median {about['median']:.3g}, 95 % below "
                f"{about['quantile_95']:.3g}"
            )
            lines += _item(name, f"{text} [{about['units']}]")
    return lines


def _paragraph(text: str) -> list[str]:
    return [fill(text, WIDTH)]


def _item(name: str, text: str) -> list[str]:
    return [fill(f"- {name}: {text}", WIDTH, subsequent_indent="  ")]

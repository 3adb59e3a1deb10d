"""The README.txt of a bundle: what each file is, and what to do with it in other programs."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any

WIDTH = 100
PROGRAMS = {
    "Blender (4.2 or later)": (
        "Import model.glb (File > Import > glTF 2.0). Lengths are metres there. For the measured colours, open "
        "maps/albedo.exr as an image texture with the colour space Linear Rec.709 and connect it to the base colour; "
        "connect maps/normal_tangent.exr, times 0.5 plus 0.5, to a Normal Map node (Tangent Space) with the colour "
        "space Non-Color. For light under the skin, set the subsurface weight to 1 and the subsurface radius to "
        "maps/translucency.exr times 0.001 (mm to m).",
    ),
    "Programs that read USD or MaterialX (Houdini, Omniverse, Arnold, Karma, ...)": (
        "Load usd/face.usda: the mesh in mm (metersPerUnit = 0.001), with an OpenPBR material whose subsurface_radius "
        "is the diffusion length in mm, and a UsdPreviewSurface for viewers without MaterialX. usd/face.mtlx holds the "
        "material alone. Keep the folder maps beside it: the diffusion length is maps/translucency.exr.",
    ),
    "Mitsuba 3": (
        "Run python mitsuba/skin.py picture.exr where the packages mitsuba and numpy are installed. The program holds "
        "a BSDF with the exact measured BRDFs, which it mixes by maps/weight_<k>.exr; import it into scenes of your "
        "own. Light under the skin is not carried there.",
    ),
    "Unreal Engine 5": (
        "Import model.glb (Interchange). Choose the shading model Subsurface Profile, with the mean free path from "
        "maps/translucency.exr: Unreal counts in centimetres, so divide mm by 10. Import maps/normal_tangent.exr "
        "with the compression Normalmap; the green channel must be flipped there, because Unreal's points down.",
    ),
    "Renderers that read MERL binaries": (
        "bases/component_<k>.binary are the components of the surface BRDF in the format of the MERL database; mix "
        "them with maps/weight_<k>.exr and add the diffuse term of manifest.json, conventions, reflectance.",
    ),
}


def readme(manifest: Mapping[str, Any]) -> str:
    """The text, from what the manifest says."""
    parts = [
        "skindb bundle",
        "=============",
        "",
        *_paragraph(f"Written by {manifest['written_by']}. {_edited(manifest)}"),
    ]
    parts += ["", "Files", "-----", ""]
    for name, about in manifest["files"].items():
        parts += _item(name, f"{about['holds']} [{about['units']}], {about['bytes'] / 1e6:.1f} MB")
    parts += ["", "Units, frames and colours", "-------------------------", ""]
    for name, text in manifest["conventions"].items():
        parts += _item(name, text)
    parts += ["", "What to do with it", "------------------", ""]
    for name, (text,) in PROGRAMS.items():
        parts += [f"{name}:", *_paragraph(text), ""]
    parts += ["How wrong it is", "---------------", "", *_errors(manifest)]
    return "\n".join(parts) + "\n"


def _edited(manifest: Mapping[str, Any]) -> str:
    edited = manifest["edited"]
    return f"The face was edited: {edited}." if edited else "The face is as it was measured."


def _errors(manifest: Mapping[str, Any]) -> list[str]:
    """The measured errors of the exports, and of the model itself."""
    error = manifest["files"]["model.glb"]["approximation_error"]
    lines = _item("maps and bases", "exact: they are the model, in single and half precision")
    lines += _item(
        "model.glb",
        f"pictures by its material differ from those of the model by {error['relative_rms']:.1%} (root mean square "
        "over lights and cameras in all directions, relative), between cube roots, as the eye judges, by "
        f"{error['relative_rms_perceptual']:.1%}; normals by {error['normal_error_degrees']:.2f} degrees (median)",
    )
    error = manifest["files"]["usd/face.usda"]["approximation_error"]
    lines += _item("mitsuba/skin.py", "exact; light leaves where it enters")
    lines += _item(
        "usd/face.usda",
        f"the same comparison gives {error['relative_rms']:.1%} and {error['relative_rms_perceptual']:.1%}, by the "
        "equations of glTF with one index of refraction; renderers differ in how they layer OpenPBR",
    )
    for name, about in manifest["error"].items():
        if isinstance(about, Mapping) and "median" in about:
            text = f"{about['meaning']}: median {about['median']:.3g}, 95 % below {about['quantile_95']:.3g}"
            lines += _item(name, f"{text} [{about['units']}]")
    return lines


def _paragraph(text: str) -> list[str]:
    return [fill(text, WIDTH)]


def _item(name: str, text: str) -> list[str]:
    return [fill(f"- {name}: {text}", WIDTH, subsequent_indent="  ")]

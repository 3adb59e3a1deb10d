"""Pictures of an exported bundle in Blender and Mitsuba 3, compared with those of skindb.

python -m benchmarks exports DB [--take NAME] [--blender PYTHON] [--mitsuba PYTHON]
[--out FOLDER] [--picture FILE]

DB contains a fitted model with translucency. PYTHON is an interpreter with the package
of that renderer:

    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1  # needs 3.11
    python3 -m venv mitsuba && mitsuba/bin/pip install mitsuba==3.9.1 numpy

Every program gets the same pinhole camera in front of the face and the same point
light, and follows direct light only. Files are used as README.txt of the bundle says.
For each light and way of use, the median ratio and the root mean square difference from
skindb are printed (also in cube-root space), over pixels of measured and lit skin; the
pictures and the figures of each region are in FOLDER. The same is printed for controls:
a matt surface, positions and normals. For light under the skin, the edge of a shadow on
a plate is compared with the dipole.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import imagecodecs
import numpy as np
import OpenEXR
from scipy.ndimage import binary_erosion
from scipy.optimize import minimize_scalar

import skindb
from skindb.export import export_bundle
from skindb.export.inputs import mean_free_path
from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import dipole_profile, dipole_s, scattering_coefficients
from skindb.render.image import tone_map, write_png
from skindb.render.rendering import chosen_camera
from skindb.render.scene import Camera, Lights, Surface, from_model, lights_from_dome
from skindb.render.shading import View, shade_view, trace_view
from skindb.render.surfels import surfel_confidence

HERE = Path(__file__).parent
SAMPLES = 128  # rays per pixel in the other programs
ANGLES = (15, 45, 75)  # degrees between camera and light, as seen from the face
WAYS = {  # file, what is connected, and the picture of skindb that it is compared with
    "matt surface (control)": ("model.glb", ["matt"], "matt"),
    "model.glb": ("model.glb", [], "whole"),
    "model.glb, albedo.exr, normal_tangent.exr": (
        "model.glb",
        ["albedo", "normal"],
        "whole",
    ),
    "the same, translucency.exr": (
        "model.glb",
        ["albedo", "normal", "translucency"],
        "subsurface",
    ),
    "the same, mean_free_path.exr": (
        "model.glb",
        ["albedo", "normal", "mean_free_path"],
        "subsurface",
    ),
    "face.usda": ("usd/face.usda", [], "whole"),
}
# in the picture for the documentation
SHOWN = ("model.glb", "the same, translucency.exr")
# light under the skin on plates: albedos, half of the width [mm], and radii [mm] for
# diffusion lengths of about 1 mm
PLATES = ((0.5, 0.3, 0.2), (0.7, 0.4, 0.1))
HALF = 10.0
PIXELS = 80
SPREADS = {
    "RANDOM_WALK_SKIN": ((2.0, 2.0, 2.0), (2.0, 2.0, 2.0)),
    "RANDOM_WALK": ((6.7, 12.7, 18.0), (3.2, 9.2, 26.0)),
    "BURLEY": ((3.9, 5.0, 5.8), (2.7, 4.4, 6.9)),
}


@dataclass(frozen=True)
class Stage:
    """What all programs render."""

    surface: Surface
    scene: RayScene
    view: View
    good: np.ndarray  # (h, w) pixels of measured skin, away from silhouettes
    regions: dict[str, np.ndarray]  # (h, w) by name


def set_stage(model) -> Stage:
    """A camera without distortion in front of the face, at twice the resolution of that
    of the dome.
    """
    camera = chosen_camera(model["dome"].to_dataset().load(), None)[0].scaled(2)
    K = camera.K.copy()
    K[0, 0] = K[1, 1] = (K[0, 0] + K[1, 1]) / 2
    camera = replace(camera, K=K, distortion=np.zeros(5))
    surface = from_model(model)
    fitted = model["fitted"].to_dataset()
    scene = RayScene(surface.vertices, surface.faces)
    view = trace_view(surface, camera, samples=4, scene=scene)
    trust = view.image(
        view.interpolate(surfel_confidence(fitted)[:, None].astype(float))
    )[..., 0]
    mask = fitted["region_mask"].transpose("surfel", "region")
    image_mask = view.image(view.interpolate(mask.values.astype(float)))
    good = binary_erosion(view.coverage > 0.999, iterations=2) & (trust > 0.99)
    names = map(str, mask["region"].values)
    return Stage(
        surface,
        scene,
        view,
        good,
        {name: image_mask[..., i] > 0.5 for i, name in enumerate(names)},
    )


def pictures(stage: Stage, light: Lights) -> dict[str, np.ndarray]:
    """Pictures of skindb under a point light."""
    matt = replace(
        stage.surface, eta=1.0, diffuse=np.full_like(stage.surface.diffuse, 0.5)
    )

    def shade(surface: Surface, **options):
        return shade_view(
            stage.view, surface, light, stage.scene, disc_samples=1, **options
        )[0]

    shaded = shade(stage.surface)
    return {
        "whole": shaded,
        "matt": shade(matt, terms=("diffuse",)),
        "subsurface": shade(stage.surface, subsurface=True)
        if stage.surface.sigma_tr is not None
        else shaded,
    }


def point_lights(model, view: View) -> dict[int, Lights]:
    """The lights of the dome nearest to the angles, as points."""
    lights = lights_from_dome(model["dome"].to_dataset().load())
    way = lights.position / np.linalg.norm(lights.position, axis=1, keepdims=True)
    ahead = view.camera.centre
    angle = np.degrees(np.arccos(way @ ahead / np.linalg.norm(ahead)))
    points = replace(
        lights, disc_radius=0 * lights.disc_radius, falloff=0 * lights.falloff
    )
    return {
        round(angle[i]): points.select(i)
        for i in (int(np.argmin(np.abs(angle - a))) for a in ANGLES)
    }


def read(path: Path, name: str, channels: str = "RGB") -> np.ndarray:
    """A pass of a picture of Blender, or the picture of Mitsuba if the name is empty."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = {
            key: value.pixels
            for part in file.parts
            for key, value in part.channels.items()
        }
        return np.stack(
            [np.array(planes[f"{name}{c}"], np.float32) for c in channels], axis=-1
        )


def difference(
    picture: np.ndarray, true: np.ndarray, mask: np.ndarray
) -> dict[str, float]:
    """Median ratio, and RMS difference over RMS, also in cube-root space."""

    def rms(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)))

    a = picture[mask]
    b = true[mask]
    ratio = [round(float(x), 4) for x in np.median(a / np.maximum(b, 1e-12), axis=0)]
    return {
        "median_ratio": ratio,
        "rms": rms(a, b),
        "rms_perceptual": rms(np.cbrt(a), np.cbrt(b)),
    }


def compare(stage: Stage, job, true: np.ndarray, picture: np.ndarray, out: Path):
    """Figures of one picture, of each region too, and the pictures side by side."""
    lit = stage.good & (true.max(axis=-1) > 0.02 * true.max())
    figures = difference(picture, true, lit)
    figures["regions"] = {
        name: difference(picture, true, lit & inside)
        for name, inside in stage.regions.items()
        if (lit & inside).sum() > 50
    }
    gain = 0.9 / np.quantile(true[lit].max(axis=-1), 0.99)
    write_png(
        out,
        np.concatenate(
            [tone_map(linear, exposure=gain) for linear in (picture, true)], axis=1
        ),
    )
    print(
        f"{job['name']}: ratio {figures['median_ratio']}, RMS "
        f"{figures['rms']:.1%}, in cube-root space "
        f"{figures['rms_perceptual']:.1%}"
    )
    return figures


def controls(stage: Stage, path: Path) -> None:
    """Differences of positions and normals."""

    def upright(name: str) -> np.ndarray:
        x, y, z = np.moveaxis(read(path, f"ViewLayer.{name}.", "XYZ"), -1, 0)
        return np.stack([x, z, -y], axis=-1)

    apart = np.linalg.norm(
        1000 * upright("Position") - stage.view.image(stage.view.position), axis=-1
    )[stage.good]
    a = upright("Normal")[stage.good]
    b = stage.view.image(stage.view.normal)[stage.good]
    cosine = (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    print(
        f"  positions differ by {np.median(apart):.4f} mm (median), normals by "
        f"{np.median(angle):.2f} degrees (median; "
        f"95 % {np.quantile(angle, 0.95):.2f})"
    )


def edge(albedo: float, length: float, across: np.ndarray) -> np.ndarray:
    """Light that leaves a plate at these distances [mm] from the edge of a shadow, by
    the dipole; 1 is full light.
    """
    absorption, scattering = scattering_coefficients(
        dipole_s(np.array(albedo), eta=1.3)[0], np.array(1 / length)
    )
    line = np.linspace(0, 15, 601)
    along = np.concatenate([[0], np.geomspace(1e-4, 60, 2000)])
    far = np.hypot(line[:, None], along)
    spread = 2 * np.trapezoid(
        dipole_profile(far, float(absorption), float(scattering), eta=1.3),
        along,
        axis=1,
    )
    half = np.concatenate([[0], np.cumsum((spread[1:] + spread[:-1]) / 2)])
    half = half / half[-1] / 2
    return 0.5 + np.sign(across) * np.interp(np.abs(across), line, half)


def spread_jobs(folder: Path) -> list[dict]:
    """Plates in even light and half in shadow, for each method of Blender."""
    return [
        {
            "plate": {
                "albedo": PLATES[i],
                "method": method,
                "radius": [x / 1000 for x in radii[i]],
                "blocked": blocked,
            },
            "size": [PIXELS, 8],
            "samples": 1024 if blocked else 256,
            "out": str(folder / f"{method}_{i}_{blocked}.exr"),
        }
        for method, radii in SPREADS.items()
        for i in range(len(PLATES))
        for blocked in (False, True)
    ]


def report_spread(folder: Path) -> None:
    """How far light travels under the skin in Blender, and how much of it comes back."""
    across = HALF - (np.arange(PIXELS) + 0.5) * 2 * HALF / PIXELS
    for method, radii in SPREADS.items():
        for i, albedos in enumerate(PLATES):
            even, half = (
                read(folder / f"{method}_{i}_{blocked}.exr", "ViewLayer.Combined.")
                for blocked in (False, True)
            )
            for c, albedo in enumerate(albedos):
                level = float(even[..., c].mean())
                seen = half[..., c].mean(axis=0) / level

                def cost(x, a=albedo, s=seen):
                    return np.mean((edge(a, np.exp(x), across) - s) ** 2)

                best = minimize_scalar(cost, bounds=(-3, 2), method="bounded")
                length = float(np.exp(best.x))
                path = float(
                    mean_free_path(np.array(albedo), np.array(1 / length), eta=1.3)
                )
                print(
                    f"{method}, albedo {albedo}: returns {level / albedo:.3f} of "
                    f"it; radius {radii[i][c] / length:.2f} "
                    f"diffusion lengths, {radii[i][c] / path / np.pi:.2f} pi mean "
                    "free paths; edge differs by "
                    f"{np.sqrt(best.fun):.4f}"
                )


def draw(paths: list[Path], picture: Path) -> None:
    """Pairs of pictures in a row, without the dark columns and rows between them."""
    pictures = [imagecodecs.png_decode(path.read_bytes()) for path in paths]
    halves = [half for pair in pictures for half in np.split(pair, 2, axis=1)]
    lit = np.any([half.max(axis=2) > 8 for half in halves], axis=0)
    rows, columns = (np.flatnonzero(lit.any(axis=axis)) for axis in (1, 0))
    write_png(
        picture,
        np.concatenate([half[np.ix_(rows, columns)] for half in halves], axis=1),
    )


def run(python: str, program: str, jobs: list[dict], folder: Path) -> None:
    """Render jobs in another program."""
    described = folder / "jobs.json"
    described.write_text(json.dumps(jobs), encoding="utf-8")
    subprocess.run(
        [python, str(HERE / "programs" / program), str(described)],
        check=True,
        stdout=subprocess.DEVNULL,
    )


def described(camera: Camera, light: Lights) -> dict:
    """Camera and light for other programs."""
    K = camera.K.tolist()
    R = camera.R.tolist()
    centre = camera.centre.tolist()
    description = {
        "K": K,
        "R": R,
        "centre": centre,
        "width": camera.width,
        "height": camera.height,
    }
    lamp = {
        "position": light.position[0].tolist(),
        "intensity": light.intensity[0].tolist(),
    }
    return {
        "camera": description,
        "light": lamp,
        "size": [camera.width, camera.height],
        "samples": SAMPLES,
    }


def main(
    db: str,
    *,
    take: str | None = None,
    blender: Annotated[str | None, "Python with bpy"] = None,
    mitsuba: Annotated[str | None, "Python with mitsuba and numpy"] = None,
    out: Path | None = None,
    picture: Annotated[
        Path | None,
        "picture of the second light, without and with light under the skin",
    ] = None,
) -> None:
    """Print the differences, and write pictures and figures."""
    out = (out or Path(tempfile.mkdtemp())).absolute()
    database = skindb.open(db)
    model = database.read("model", take or database.takes("model")[0])
    bundle = export_bundle(model, out / "bundle", merl=False).parent
    stage = set_stage(model)
    lights = point_lights(model, stage.view)
    figures = {}
    for angle, light in lights.items():
        print(f"light at {angle} degrees from the camera")
        true = pictures(stage, light)
        scene = described(stage.view.camera, light) | {"maps": str(bundle / "maps")}
        jobs, exact = jobs_of(scene, bundle, f"{out}/{angle}")
        rendered = []
        if blender:
            run(blender, "exports_blender.py", jobs, out)
            rendered += [(job, "ViewLayer.Combined.") for job in jobs]
            controls(stage, Path(jobs[0]["out"]))
        if mitsuba:
            run(mitsuba, "exports_mitsuba.py", [exact], out)
            rendered.append((exact, ""))
        for job, channels in rendered:
            values = read(Path(job["out"]), channels)
            picture_path = Path(job["out"]).with_suffix(".png")
            name = f"{angle}: {job['name']}"
            figures[name] = compare(stage, job, true[job["true"]], values, picture_path)
    if blender:
        run(blender, "exports_blender.py", spread_jobs(out), out)
        report_spread(out)
        if picture:
            angle = list(lights)[1]
            numbers = [list(WAYS).index(name) for name in SHOWN]
            draw([out / f"{angle}_{number}.png" for number in numbers], picture)
    text = json.dumps(figures, indent=1) + "\n"
    (out / "figures.json").write_text(text, encoding="utf-8")
    print(f"pictures, and the figures of each region: {out}")


def jobs_of(
    scene: dict[str, Any], bundle: Path, stem: str
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """One rendering in Blender for each file of the bundle, and the exact one in Mitsuba."""
    jobs = []
    for i, (name, (file, use, key)) in enumerate(WAYS.items()):
        names = {"name": name, "file": str(bundle / file), "use": use, "true": key}
        jobs.append(scene | names | {"out": f"{stem}_{i}.exr"})
    names = {"name": "mitsuba/skin.py", "true": "whole", "out": f"{stem}_mitsuba.exr"}
    return jobs, scene | names

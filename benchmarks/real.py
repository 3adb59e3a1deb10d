"""Errors on photographs of real faces and objects and on measured BRDFs, of skindb and
of simple models.

    python -m benchmarks real DATA [--parts faces cat ...] [--json results.json]

DATA contains photometric/yale, photometric/diligent, photometric/uw, exposures,
brdf/merl_slices_phid90.npz and optics/issa2025_skin.csv. A part whose files are absent
is skipped with the reason. Every fifth light is held out. The error of a pixel is the RMS
error of its held-out samples over their RMS, and the table has the median over pixels.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from benchmarks.peers import PEERS, Fit, fit, mixture
from benchmarks.real_brdfs import brdf_rows
from benchmarks.real_exposures import ball_rows, exposure_rows
from benchmarks.real_photographs import (
    Photographs,
    cat,
    faces,
    gray_sphere,
    spread_lights,
)
from benchmarks.surface_energy import spectrum_rows
from skindb.fit import (
    embedded_dictionary,
    estimate_diffuse_reflectance,
    estimate_gloss,
    estimate_light_gains,
    estimate_normals,
    fit_surface,
    light_residuals,
    refine_jointly,
    refit,
)
from skindb.fit.corrections import LightErrors, LightResiduals
from skindb.fit.gloss import common_lobes, take_gloss
from skindb.fit.rig import Common
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.tables import kernel_tables, lookup
from skindb.schema import dataset, label

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FAR_MM = 1e6  # distance of lights and camera; pixels have a spacing of 1 mm
# error of the scan's normals for which their prior has no effect
NO_SCAN_DEGREES = 60.0
# refractive indices; matt plaster has no smooth boundary
SKIN = 1.3
PLASTER = 1.0
# 95 % of the angles of two equal axes, over their RMS
ISOTROPIC_95 = float(np.sqrt(-np.log(0.05)))
# of a white facing surface times pi; smaller predictions tell nothing about gains
MIN_PREDICTED = 0.01
GAIN_ROUNDS = 3
BASES = 4
FEW_LIGHTS = 8
LIGHT_COUNTS = (4, 6, 8, 12, 24)
PARTS = (
    "faces",
    "cat",
    "lights",
    "face-lights",
    "sphere",
    "brdfs",
    "exposures",
    "ball",
    "spectra",
)

ANGLE = "normals, mean, median [deg]"
COVERAGE = "within the stated error, the total error [%]"

Method = Callable[[Photographs, Mask], "Fitted"]


@dataclass(frozen=True)
class Fitted:
    """Normals (n, 3), predictions (n, light) for all lights, and stated errors (n,) of
    the normals [degree].
    """

    normal: Array
    predicted: Array
    normal_error: Array | None = None
    normal_total_error: Array | None = None


def samples_of(photographs: Photographs, chosen: NDArray[np.intp]) -> xr.Dataset:
    """Lumitexels of the pixels under some of the lights."""
    part = photographs.with_lights(chosen)
    sample = np.where(part.usable[:, :, None], part.sample, np.nan)
    count = len(sample)
    return dataset(
        {
            "reflectance_sample": np.broadcast_to(sample, (*sample.shape[:2], 3))[
                :, :, None
            ],
            "noise_floor": np.array(0.0),
            "surfel_position": np.zeros((count, 3)),
            "surfel_normal": np.tile([0.0, 0.0, 1.0], (count, 1)),
            "surfel_area": np.ones(count),
            "light_position": FAR_MM * part.light,
            "light_disc_radius": np.zeros(len(part.light)),
            "camera_position": np.array([[0.0, 0.0, FAR_MM]]),
        },
        coords={"channel": ["R", "G", "B"]},
    )


def skindb_fit(
    photographs: Photographs,
    training: Mask,
    *,
    eta: float,
    lobes: Mapping[str, Array] = MappingProxyType({}),
) -> Fitted:
    """Normals, R_d, dictionary and reduced basis of skindb, and the predictions of the model;
    with the lobes (8,) of a rig by the name of the object.
    """
    samples = samples_of(photographs, np.flatnonzero(training))
    if lobes:
        applied = np.tile(lobes[photographs.name], (samples.sizes["surfel"], 1))
        samples = samples.assign(
            lobe_strength_applied=label("lobe_strength_applied", applied)
        )
    samples, predict = fitted_samples(samples, eta=eta)
    predicted = predict(photographs.light, np.array([0.0, 0.0, 1.0]))
    normal = samples["shading_normal"].values.astype(np.float64)
    errors = (samples[name].values for name in ("normal_error", "normal_total_error"))
    return Fitted(normal, predicted, *errors)


def fitted_samples(
    samples: xr.Dataset, *, eta: float
) -> tuple[xr.Dataset, Callable[[Array, Array], Array]]:
    """The lumitexels of one camera with normals and R_d, without a scan, and the
    prediction by the reduced basis of samples (n, light), NaN for pixels without a
    normal, from directions ([n,] light, 3) to lights and ([n,] 3) to a camera.
    """
    dictionary = embedded_dictionary()
    samples = samples.merge(
        estimate_normals(samples, eta=eta, scan_error=NO_SCAN_DEGREES)
    )
    samples = samples.merge(estimate_diffuse_reflectance(samples, eta=eta))
    gloss = estimate_gloss(samples, eta=eta, scan_error=NO_SCAN_DEGREES)
    samples = samples.assign(
        refine_jointly(samples, eta=eta, scan_error=NO_SCAN_DEGREES, gloss=gloss)
    )
    mixture_model = Mixture.of_dictionary(dictionary)
    surface = fit_surface(samples, surface=mixture_model, eta=eta)
    basis = mixture_model.reduced(
        surface.merge(samples), k=BASES, rng=np.random.default_rng(1)
    )
    # pixels with few samples have no gloss
    weight = np.nan_to_num(refit(samples, basis=basis, eta=eta)["basis_weight"].values)
    normal = samples["shading_normal"].values.astype(np.float64)
    diffuse = samples["diffuse_reflectance"].values.mean(axis=1)
    table = kernel_tables(basis)
    return samples, partial(_predicted, normal, diffuse, weight, table, eta)


def _predicted(
    normal: Array,
    diffuse: Array,
    weight: Array,
    table: NDArray[np.float32],
    eta: float,
    light: Array,
    view: Array,
) -> Array:
    """See `fitted_samples`."""
    unknown = ~np.isfinite(normal).all(axis=1) | ~np.isfinite(diffuse)
    normal = np.where(unknown[:, None], [0.0, 0.0, 1.0], normal)
    view = np.broadcast_to(view, normal.shape)
    seen = np.clip((normal * view).sum(axis=1), 1e-3, 1)
    through = fresnel_transmittance(seen, eta) * diffuse / np.pi
    columns = []
    for k in range(light.shape[-2]):
        direction = np.broadcast_to(light[..., k, :], normal.shape)
        lit = np.clip((normal * direction).sum(axis=1), 0, 1)
        angles = half_difference(direction, view, normal)
        surface = (lookup(table, *angles) * weight).sum(axis=1)
        matt = through * fresnel_transmittance(np.maximum(lit, 1e-3), eta)
        columns.append(lit * (matt + surface))
    return np.where(unknown[:, None], np.nan, np.stack(columns, axis=1))


def peer_fit(
    photographs: Photographs, training: Mask, *, estimate: Callable[..., Fit]
) -> Fitted:
    """A simple model, fitted to the mean of the channels."""
    result = estimate(photographs.grey, photographs.usable, photographs.light, training)
    return Fitted(result.normal, result.predicted)


def methods(eta: float) -> dict[str, Method]:
    """Every compared method by its name."""
    peers: dict[str, Method] = {
        peer.name: partial(peer_fit, estimate=partial(fit, peer)) for peer in PEERS
    }
    peers["mixture of GGX lobes"] = partial(peer_fit, estimate=mixture)
    return {"skindb": partial(skindb_fit, eta=eta)} | peers


def prediction_error(
    photographs: Photographs, predicted: Array, chosen: Mask, *, scaled: bool = False
) -> float:
    """Median over pixels of the relative RMS error [%]; `scaled` by one factor for each light."""
    observed = photographs.grey
    if scaled:
        predicted = predicted * light_factors(photographs, predicted)
    compared = photographs.usable & chosen & np.isfinite(predicted)
    wrong = np.where(compared, predicted - observed, 0.0)
    known_values = np.where(compared, observed, 0.0)
    square = (known_values**2).sum(axis=1)
    error = np.sqrt((wrong**2).sum(axis=1)[square > 0] / square[square > 0])
    return 100 * float(np.median(error)) if error.size else np.nan


def light_factors(photographs: Photographs, predicted: Array) -> Array:
    """Median ratio (light,) of the samples to the predictions."""
    usable = photographs.usable & (predicted > MIN_PREDICTED)
    ratio = np.where(
        usable, photographs.grey / np.where(usable, predicted, 1.0), np.nan
    )
    return np.array(
        [
            np.nanmedian(column) if np.isfinite(column).any() else 1.0
            for column in ratio.T
        ]
    )


def own_gains(photographs: Photographs, training: Mask, method: Method | None) -> Array:
    """Gains (light,) from the training lights alone: those of skindb, or of a simple
    model by alternation.
    """
    gain = np.ones(len(training))
    if method is None:
        samples = samples_of(photographs, np.flatnonzero(training))
        gain[training] = estimate_light_gains(samples, rng=np.random.default_rng(2))[
            "light_gain"
        ].values
        return gain
    for _ in range(GAIN_ROUNDS):
        predicted = method(photographs.divided_by(gain), training).predicted
        ratio = light_factors(photographs, predicted)
        gain[training] = ratio[training] / np.median(ratio[training])
    return gain


def _light_residuals(photographs: Photographs) -> LightResiduals:
    """What one person says about all lights, with the normals of a first fit."""
    everything = np.ones(len(photographs.light), np.bool_)
    samples = samples_of(photographs, np.flatnonzero(everything))
    normal = skindb_fit(photographs, everything, eta=SKIN).normal
    known = np.flatnonzero(np.isfinite(normal).all(axis=1))
    samples = samples.isel(surfel=known)
    normals = samples["surfel_normal"].copy(data=normal[known])
    return light_residuals(
        samples.assign(surfel_normal=normals), rng=np.random.default_rng(2)
    )


def common_lights(
    person: Photographs,
    others: Sequence[Photographs],
    residuals: Sequence[LightResiduals],
    *,
    turned: bool,
) -> Photographs:
    """A person with the gains, and directions if `turned`, of the lights that others have
    in common, as by `skindb calibrate --from-takes`.
    """
    takes = []
    for other, residual in zip(others, residuals, strict=True):
        own = residual.errors(turned=turned)
        names = list(other.light_name)
        at = [names.index(name) if name in names else -1 for name in person.light_name]
        unseen = np.array(at) < 0
        gain = np.where(unseen, np.nan, own.gain[at])
        offset = np.where(unseen[:, None], np.nan, own.offset[at])
        takes.append(LightErrors(gain, offset))
    common = Common(takes).errors
    moved = FAR_MM * person.light + common.offset
    light = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    return replace(person.divided_by(common.gain), light=light)


def with_lights_of_others(people: list[Photographs]) -> list[Photographs]:
    """Each person with the gains and directions of the lights from the others."""
    rig = [_light_residuals(person) for person in people]
    return [
        common_lights(
            person,
            people[:k] + people[k + 1 :],
            rig[:k] + rig[k + 1 :],
            turned=True,
        )
        for k, person in enumerate(people)
    ]


def lobes_of_others(people: list[Photographs]) -> dict[str, Array]:
    """Strengths (8,) of the lobes that the other objects have in common, by name."""
    takes = {}
    for person in people:
        samples = samples_of(person, np.arange(len(person.light)))
        samples = samples.assign(
            scan_normal_error=label("scan_normal_error", NO_SCAN_DEGREES)
        )
        takes[person.name] = take_gloss(samples, eta=SKIN, regions={})
    return {
        name: common_lobes([takes[other] for other in takes if other != name])[
            "rig_lobe_strength"
        ].values[0]
        for name in takes
    }


def face_rows(people: list[Photographs]) -> list[list[str]]:
    """Errors at held-out lights of the faces [%], mean over the people."""
    rig = [_light_residuals(person) for person in people]
    title = f"{len(people)} faces: error at held-out lights [%]"
    columns = (
        "raw",
        "scaled",
        "own gains, scaled",
        "gains of others",
        "gains and directions of others",
        "the same, 8 lights",
    )
    rows = [[title, *columns]]
    for name, method in methods(SKIN).items():
        cells = []
        for k, person in enumerate(people):
            training = ~person.held_out
            equalised = person.divided_by(
                own_gains(person, training, None if name == "skindb" else method)
            )
            others = people[:k] + people[k + 1 :], rig[:k] + rig[k + 1 :]
            gains, shared = (
                common_lights(person, *others, turned=turned)
                for turned in (False, True)
            )
            raw, balanced, even, common = (
                method(part, training).predicted
                for part in (person, equalised, gains, shared)
            )
            few = method(shared, spread(person, FEW_LIGHTS)).predicted
            cells.append(
                [
                    prediction_error(person, raw, person.held_out),
                    prediction_error(person, raw, person.held_out, scaled=True),
                    prediction_error(equalised, balanced, person.held_out, scaled=True),
                    prediction_error(gains, even, person.held_out),
                    prediction_error(shared, common, person.held_out),
                    prediction_error(shared, few, person.held_out),
                ]
            )
        rows.append([name, *(f"{value:.1f}" for value in np.mean(cells, axis=0))])
    return rows


def cat_rows(photographs: Photographs) -> list[list[str]]:
    """Angles to the measured normals of the cat, coverage of the stated errors, and
    errors at held-out lights.
    """
    rows = [
        ["cat, 76 of 96 lights", ANGLE, COVERAGE, "held-out lights, raw, scaled [%]"]
    ]
    for name, method in methods(SKIN).items():
        fitted = method(photographs, ~photographs.held_out)
        angle = angles(fitted.normal, photographs.normal)
        errors = [
            prediction_error(
                photographs, fitted.predicted, photographs.held_out, scaled=s
            )
            for s in (False, True)
        ]
        rows.append(
            [
                name,
                _two(np.nanmean(angle), np.nanmedian(angle)),
                coverage(fitted, angle),
                _two(*errors),
            ]
        )
    return rows


def light_rows(objects: list[Photographs]) -> list[list[str]]:
    """Errors by the number of training lights, mean over the objects, of all models at
    the pixels for which skindb has one.
    """
    measured = objects[0].normal is not None
    title = "cat: normals, mean [deg] / held-out lights [%]"
    if not measured:
        title = f"{len(objects)} faces, lights by the others: held-out lights [%]"
    rows = [[title, *(f"{n} lights" for n in LIGHT_COUNTS)]]
    known = dict[tuple[str, int], Mask]()
    covered = []
    compared = methods(SKIN)
    if not measured:
        compared["skindb with the lobes of the others"] = partial(
            skindb_fit, eta=SKIN, lobes=lobes_of_others(objects)
        )
    for name, method in compared.items():
        cells = []
        for count in LIGHT_COUNTS:
            errors = []
            for photographs in objects:
                fitted = method(photographs, spread(photographs, count))
                key = (photographs.name, count)
                if name == "skindb":
                    known[key] = np.isfinite(fitted.predicted).any(axis=1)
                    if measured:
                        angle = angles(fitted.normal, photographs.normal)
                        covered.append(coverage(fitted, angle))
                errors.append(_errors_at(photographs, fitted, known[key]))
            angle, error = np.mean(errors, axis=0)
            cells.append(f"{angle:.1f} / {error:.1f}" if measured else f"{error:.1f}")
        rows.append([name, *cells])
    fractions = [
        100 * np.mean([known[o.name, count].mean() for o in objects])
        for count in LIGHT_COUNTS
    ]
    rows.append(
        [
            "pixels with a model of skindb [%]",
            *(f"{value:.0f}" for value in fractions),
        ]
    )
    return [*rows, ["normals of skindb " + COVERAGE, *covered]] if measured else rows


def spread(photographs: Photographs, count: int) -> Mask:
    """Training lights (light,) in directions that are far from each other."""
    training = np.flatnonzero(~photographs.held_out)
    chosen = np.zeros(len(photographs.light), np.bool_)
    chosen[training[spread_lights(photographs.light[training], count)]] = True
    return chosen


def _errors_at(
    photographs: Photographs, fitted: Fitted, known: Mask
) -> tuple[float, float]:
    """Mean angle, NaN without measured normals, and prediction error at some pixels."""
    angle = np.nan
    if photographs.normal is not None:
        angle = float(np.nanmean(angles(fitted.normal, photographs.normal)[known]))
    predicted = np.where(known[:, None], fitted.predicted, np.nan)
    return angle, prediction_error(photographs, predicted, photographs.held_out)


def sphere_rows(photographs: Photographs) -> list[list[str]]:
    """Angles to the normals of the gray sphere under twelve lights."""
    rows = [["gray sphere, 12 lights", ANGLE, COVERAGE]]
    everything = np.ones(len(photographs.light), np.bool_)
    for name, method in methods(PLASTER).items():
        fitted = method(photographs, everything)
        angle = angles(fitted.normal, photographs.normal)
        rows.append(
            [
                name,
                _two(np.nanmean(angle), np.nanmedian(angle)),
                coverage(fitted, angle),
            ]
        )
    return rows


def angles(estimated: Array, true: Array | None) -> Array:
    """Angles (n,) [degree]."""
    if true is None:
        raise ValueError("the object has no measured normals")
    return np.asarray(
        np.degrees(np.arccos(np.clip((estimated * true).sum(axis=1), -1, 1)))
    )


def coverage(fitted: Fitted, angle: Array) -> str:
    """Percentage of angles within the 95 % limits of the two stated errors."""
    if fitted.normal_error is None or fitted.normal_total_error is None:
        return "-"
    errors = (fitted.normal_error, fitted.normal_total_error)
    return _two(
        *(
            100 * np.mean(angle[np.isfinite(e)] < ISOTROPIC_95 * e[np.isfinite(e)])
            for e in errors
        ),
        places=0,
    )


def _two(left_value: float, right_value: float, places: int = 1) -> str:
    return f"{left_value:.{places}f}, {right_value:.{places}f}"


def measure(data: Path, part: str) -> list[list[str]] | str:
    """Rows of one part, or the reason why it is skipped."""
    photometric = data / "photometric"
    needed = {
        "faces": photometric / "yale" / "yaleB12.npz",
        "cat": photometric / "diligent" / "cat.npz",
        "lights": photometric / "diligent" / "cat.npz",
        "face-lights": photometric / "yale" / "yaleB12.npz",
        "sphere": photometric / "uw" / "light_directions_chrome.csv",
        "brdfs": data / "brdf" / "merl_slices_phid90.npz",
        "exposures": data / "exposures" / "memorial",
        "ball": photometric / "uw" / "light_directions_chrome.csv",
        "spectra": data / "optics" / "issa2025_skin.csv",
    }[part]
    if not needed.exists():
        return f"{part}: skipped, {needed} does not exist"
    if part == "faces":
        return face_rows(faces(needed.parent))
    if part == "cat":
        return cat_rows(cat(needed.parent))
    if part == "lights":
        return light_rows([cat(needed.parent)])
    if part == "face-lights":
        return light_rows(with_lights_of_others(faces(needed.parent)))
    if part == "sphere":
        return sphere_rows(gray_sphere(needed.parent))
    if part == "exposures":
        return exposure_rows(needed.parent)
    if part == "ball":
        return ball_rows(needed.parent)
    if part == "spectra":
        return spectrum_rows(needed)
    return brdf_rows(needed)


def main(
    data: Annotated[Path, "Folder of the photographs and measured BRDFs."],
    *,
    parts: Annotated[Sequence[str], "What is measured.", PARTS] = tuple(PARTS),
    json_: Annotated[Path | None, "File for the results."] = None,
) -> None:
    """Measure and print."""
    results = {}
    for part in parts:
        results[part] = measure(data, part)
        print("\n".join(_lines(results[part])), end="\n\n", flush=True)
    if json_:
        json_.write_text(json.dumps(results, indent=1), encoding="utf-8")


def _lines(rows: list[list[str]] | str) -> list[str]:
    """A Markdown table, or the reason why there is none."""
    if isinstance(rows, str):
        return [rows]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return [lines[0], "|---" * len(rows[0]) + "|", *lines[1:]]

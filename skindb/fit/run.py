"""The fit of one take: every stage in order, from the version of its capture to a version of its model."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.fit._clock import Clock, Progress
from skindb.fit.albedo import estimate_diffuse_reflectance
from skindb.fit.basis import reduce_basis
from skindb.fit.held_out import ERRORS, Split, held_out_error, split_take
from skindb.fit.lumitexels import lumitexels
from skindb.fit.normals import estimate_normals
from skindb.fit.outliers import find_outliers, suspects
from skindb.fit.prediction import describe_prediction, prediction_table
from skindb.fit.surface import FullMode, fit_surface, refit
from skindb.fit.translucency import fit_probe, translucency_map
from skindb.plan import Plan, plan_fit, with_rank
from skindb.schema import FitStatus, dataset

if TYPE_CHECKING:
    from skindb.numerics.nnls import Mode
    from skindb.optics.dictionary import Dictionary
    from skindb.store import Database, Record

COPIED = ("surfel_position", "surfel_normal", "surfel_area", "surfel_uv", "region_mask")
KEPT_ATTRS = ("subject", "condition", "session", "traits", "consent_scope")
COPIED_GROUPS = ("mesh", "dome", "probe")
KNOWN = ("shading_normal", "normal_error", "diffuse_reflectance", "diffuse_reflectance_error", "reduced_weight")
REPORTED = (
    "full_basis_residual",
    "fit_residual",
    "fit_residual_perceptual",
    "kkt_residual",
    *ERRORS["light"],
    *ERRORS["camera"],
    "outlier_share",
    "normal_disagreement",
)
SCOPE = "fit"


def fit_take(
    db: Database,
    take: str,
    *,
    k: int = 4,
    mode: FullMode = "perceptual",
    rank: int = 16,
    eta: float = 1.3,
    profile: str = "transport",
    hold_out_lights: float = 0.0,
    hold_out_cameras: float = 0.0,
    seed: int = 0,
    dictionary: Dictionary | None = None,
    plan: Plan | None = None,
    progress: Progress | None = None,
) -> tuple[Record, dict[str, Any]]:
    """Fit one take and commit its model.

    Parameters
    ----------
    db
        Database with a version of kind "capture" of the take.
    take
        Name of the take.
    k
        Components of the reduced basis; fewer where fewer surfels were fitted.
    mode, rank
        Of the fit with every basis, see `fit_surface`. After "paper" the reduced basis is fitted in "perceptual".
    eta
        Refractive index of skin.
    profile
        What the probe is fitted with, see `fit_probe`.
    hold_out_lights, hold_out_cameras
        Shares of lights and cameras kept from the fit, to measure the error of predictions there.
    seed
        Of everything random: held-out lights and cameras, sampled surfels, starts of the factorisation.
    dictionary
        Measured BRDFs for point lights; default the embedded 59.
    plan
        What is left out; default `plan_take`. The version of the capture it was made of is the one that is fitted.
    progress
        Called with stage, steps done and steps in all.

    Returns
    -------
    record, report
        The committed record; and seconds per stage, share of surfels per status, errors by region and status, medians
        of the residuals and of the held-out errors, lights and cameras that many samples of contradict the model, what
        was left out and why.

    Raises
    ------
    InputError
        Consent without the scope "fit", no capture, a capture that does not fit the schema, or no surfel that could
        be fitted. Nothing is committed then.
    """
    capture = db.read("capture", take, generation=plan.generation if plan else None)
    _require_fit(capture.attrs, take, hold_out_lights, hold_out_cameras)
    clock = Clock(progress)
    whole = lumitexels(capture)
    with clock.stage("dictionary"):
        tables = _convolved(dictionary, _disc_angle(whole))
        plan = plan or plan_take(capture, mode=mode, rank=rank, dictionary=dictionary)
    _require_samples(plan, take)
    _require_components(k, len(tables.names))
    rank = min(rank, len(tables.names))  # what is done is what is recorded
    split = split_take(whole, capture, plan, lights=hold_out_lights, cameras=hold_out_cameras, seed=seed)
    fitted, basis = _fit_surfels(split.work, clock, tables, k=k, mode=mode, rank=rank, eta=eta, seed=seed)
    fitted = fitted.merge(_predict_held_out(split, fitted, clock, basis=basis, eta=eta))
    with clock.stage("outliers"):
        outliers = find_outliers(_with(split.work, fitted), basis=basis, eta=eta)
        fitted = fitted.merge(outliers[["outlier_share"]])
    groups = _groups(capture, _scatter(fitted, plan.surfels), basis)
    groups["outliers"] = outliers.drop_dims("surfel")
    if plan.translucency:
        with clock.stage("translucency"):
            sites = fit_probe(groups["probe"], eta=eta, profile=profile)
            groups["translucency"] = sites.merge(groups["probe"][["site_position"]])
            groups["fitted"] = groups["fitted"].merge(translucency_map(groups["fitted"], groups["translucency"]))
    parameters: dict[str, Any] = {"k": basis.sizes["component"], "mode": mode, "rank": rank, "eta": eta}
    parameters |= {"profile": profile}
    parameters |= {"hold_out_lights": hold_out_lights, "hold_out_cameras": hold_out_cameras}
    parameters |= {"dictionary": tables.source, "seed": seed}
    report = _report(groups["fitted"], split, plan) | _files(tables)
    report |= {"suspects": suspects(outliers, split.work)}
    with clock.stage("write"), db.stage("model", take) as stage:
        stage.write(groups)
        provenance = _provenance(db, take, capture, parameters) | report | {"seconds": clock.seconds}
        record = stage.commit(provenance)
    prediction = describe_prediction(prediction_table(groups["fitted"]))
    return record, report | {"seconds": clock.seconds, "prediction": prediction}


def plan_take(
    capture: xr.DataTree, *, mode: FullMode = "perceptual", rank: int = 16, dictionary: Dictionary | None = None
) -> Plan:
    """What `fit_take` with these parameters leaves out of a capture."""
    plan = plan_fit(capture)
    tables = _convolved(dictionary, _disc_angle(lumitexels(capture)))
    return with_rank(plan, tables, rank=rank, cube_roots=mode == "paper")


def _fit_surfels(
    work: xr.Dataset, clock: Clock, tables: Dictionary, *, k: int, mode: FullMode, rank: int, eta: float, seed: int
) -> tuple[xr.Dataset, xr.Dataset]:
    """The stages that see samples; each reads them once (a tenth of its time) and leaves small arrays in memory."""
    with clock.stage("normals"):
        fitted = estimate_normals(work, eta=eta).compute()
    with clock.stage("diffuse reflectance"):
        fitted = fitted.merge(estimate_diffuse_reflectance(_with(work, fitted), eta=eta).compute())
    with clock.stage("surface"):
        found = fit_surface(_with(work, fitted), dictionary=tables, mode=mode, rank=rank, eta=eta).compute()
        fitted = fitted.merge(found)
    with clock.stage("reduced basis"):
        good = int((fitted["fit_status"] == FitStatus.FITTED).sum())
        basis = reduce_basis(
            fitted.merge(work[["surfel_area"]]),
            dictionary=tables,
            k=max(1, min(k, good)),
            rng=np.random.default_rng([seed, 1]),
        )
    with clock.stage("refit"):
        mixing: Mode = "perceptual" if mode == "paper" else mode  # only mixtures of BRDFs can be rendered
        fitted = fitted.merge(refit(_with(work, fitted), basis=basis, mode=mixing, eta=eta).compute())
    return fitted, basis


def _predict_held_out(split: Split, fitted: xr.Dataset, clock: Clock, *, basis: xr.Dataset, eta: float) -> xr.Dataset:
    """Errors at the lights and at the cameras the fit did not see, as far as there are any."""
    known, errors = fitted[["shading_normal", "diffuse_reflectance", "reduced_weight"]], xr.Dataset()
    held = {"light": split.lights, "camera": split.cameras}
    if any(samples.sizes[what] for what, samples in held.items()):
        with clock.stage("held out"):
            for what, samples in held.items():
                if samples.sizes[what]:
                    found = held_out_error(samples.merge(known), basis=basis, eta=eta, of=what)
                    errors = errors.merge(found.compute())
    return errors


def _with(work: xr.Dataset, fitted: xr.Dataset) -> xr.Dataset:
    """Lumitexels with what is known already, cut like the samples."""
    return work.merge(fitted[[name for name in KNOWN if name in fitted]])


def _require_fit(attrs: Mapping[Any, Any], take: str, hold_out_lights: float, hold_out_cameras: float) -> None:
    faults = []
    scope = [str(item) for item in attrs.get("consent_scope", [])]
    if SCOPE not in scope:
        found = f"only {', '.join(scope)}" if scope else "no scope at all"
        cure = "ask the subject, then correct capture.json and ingest again"
        faults.append(Fault(f"{take}: consent_scope", f"this step needs the scope {SCOPE!r}", found, cure))
    for what, share in (("lights", hold_out_lights), ("cameras", hold_out_cameras)):
        if not 0 <= share < 1:
            rule = f"the share of {what} held out lies in [0, 1)"
            faults.append(Fault(f"hold_out_{what}", rule, str(share), "give a share such as 0.1"))
    if faults:
        raise InputError(faults)


def _require_components(k: int, most: int) -> None:
    if not 1 <= k <= most:  # before the work, not after it
        raise InputError(
            Fault("k", f"a reduced basis of this dictionary has 1 to {most} components", str(k), "choose k")
        )


def _require_samples(plan: Plan, take: str) -> None:
    if not plan.surfels.any() or not plan.lights.any():
        rule = "a fit needs surfels that a camera sees lit"
        cure = "check calibration, mesh and frames of the capture, then ingest again"
        raise InputError(Fault(f"{take}: samples", rule, "no usable sample", cure))


def _disc_angle(whole: xr.Dataset) -> float:
    """Median angular radius [rad] of the lights as seen from the middle of the surfels; 0 for point lights."""
    middle = whole["surfel_position"].values.astype(np.float64).mean(axis=0)
    distance = np.linalg.norm(whole["light_position"].values - middle, axis=1)
    return float(np.median(np.arctan2(whole["light_disc_radius"].values, distance)))


def _convolved(dictionary: Dictionary | None, angle: float) -> Dictionary:
    """Tables averaged over the lights' disc, whose radius is rounded to a hundredth of a degree."""
    from skindb.optics.dictionary import convolve_disc, embedded_dictionary

    return convolve_disc(dictionary or embedded_dictionary(), float(np.radians(np.round(np.degrees(angle), 2))))


def _files(tables: Dictionary) -> dict[str, Any]:
    """Of the files the BRDFs were read from: what to know of them, and their sums."""
    if not tables.origins:
        return {}
    sums = {name: origin.sha256 for name, origin in zip(tables.names, tables.origins, strict=True)}
    return {"dictionary_notes": list(tables.notes), "dictionary_sha256": sums}


def _scatter(fitted: xr.Dataset, seen: NDArray[np.bool_]) -> xr.Dataset:
    """Results of the surfels of the plan at their places among all; the others are unseen."""
    if seen.all():
        return fitted
    index = np.flatnonzero(seen)

    def spread(array: xr.DataArray) -> Any:
        if "surfel" not in array.dims:
            return array.values
        empty = FitStatus.UNSEEN if array.name == "fit_status" else 0 if array.dtype.kind in "iu" else np.nan
        out = np.full((len(seen), *array.shape[1:]), empty, array.dtype)
        out[index] = array.values
        return out

    coords = {str(d): fitted.coords[d].values for d in fitted.dims if d in fitted.coords and d != "surfel"}
    return dataset({str(name): spread(fitted[name]) for name in fitted.data_vars}, coords=coords)


def _groups(capture: xr.DataTree, fitted: xr.Dataset, basis: xr.Dataset) -> dict[str, xr.Dataset]:
    """Groups of the model: what was fitted, and of the capture what a reader of the model needs beside it."""
    surfels = capture["surfels"].to_dataset()
    fitted = fitted.merge(surfels[[name for name in COPIED if name in surfels]].compute())
    copied = {name: capture[name].to_dataset().compute() for name in COPIED_GROUPS if name in capture.children}
    return {"fitted": fitted, "basis": basis, **copied}


def _provenance(db: Database, take: str, capture: xr.DataTree, parameters: dict[str, Any]) -> dict[str, Any]:
    """DESIGN, section 4, promise 6; the parameters also one by one, as attributes of the model."""
    record = db.record("capture", take, capture.attrs["generation"])
    whole = hashlib.sha256("".join(f"{name} {value}\n" for name, value in sorted(record.files.items())).encode())
    source = {"kind": "capture", "take": take, "generation": record.generation, "path": record.path}
    source |= {"sha256": whole.hexdigest()}  # of the lines `file sha256` of the version
    kept = {name: capture.attrs[name] for name in KEPT_ATTRS if name in capture.attrs}
    seeds = {"fit": parameters["seed"]}
    return (
        kept
        | parameters
        | {"take": take, "command": "fit", "parameters": parameters, "seeds": seeds, "inputs": [source]}
    )


def _report(fitted: xr.Dataset, split: Split, plan: Plan) -> dict[str, Any]:
    """Shares of surfels per status, medians of the errors, lights and cameras held out, what was left out."""
    status = fitted["fit_status"].values
    shares = {member.name.lower(): float((status == member).mean()) for member in FitStatus if (status == member).any()}
    report: dict[str, Any] = {"surfels": int(status.size), "status": shares}
    for name in REPORTED:
        finite = fitted[name].values[np.isfinite(fitted[name].values)] if name in fitted else np.zeros(0)
        if finite.size:
            report[name] = {"median": float(np.median(finite)), "p95": float(np.quantile(finite, 0.95))}
    for what, held in (("light", split.lights), ("camera", split.cameras)):
        report[f"held_out_{what}s"] = [str(name) for name in held[what].values] if what in held.coords else []
    return report | {"left_out": plan.explain() if plan.omissions else []}

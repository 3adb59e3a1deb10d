"""The fit of one take: every stage in order, from a capture to a model, in two passes
over the samples.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.fit._clock import Clock
from skindb.fit.albedo import estimate_diffuse_reflectance
from skindb.fit.basis import reduce_basis
from skindb.fit.held_out import fitted_part, hold_out
from skindb.fit.inter_reflection import bounced_light, without_bounce
from skindb.fit.light_gains import (
    divided_by_gains,
    estimate_light_gains,
    summarise_gains,
)
from skindb.fit.lumitexels import disc_angle, lumitexels
from skindb.fit.normals import estimate_normals
from skindb.fit.obstructed import find_obstructed
from skindb.fit.outliers import suspects
from skindb.fit.plan import plan_fit
from skindb.fit.second import refit_and_evaluate
from skindb.fit.surface import fit_surface
from skindb.fit.translucency import fit_probe, summarise_translucency, translucency_map
from skindb.parameters import FitParameters
from skindb.reflectance.dictionary import (
    Dictionary,
    disc_dictionary,
    embedded_dictionary,
)
from skindb.reflectance.rows import Mode
from skindb.schema import FitStatus, Use, label, names_of
from skindb.schema.consent import honour_consent
from skindb.types import Progress

COPIED_GROUPS = ("mesh", "dome", "probe")
KEPT_ATTRS = ("subject", "condition", "session", "traits", "consent_scope", "take")


def fit_model(
    capture: xr.DataTree,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Fit a reflectance model to the capture of one take.

    Parameters
    ----------
    capture
        Version of kind "capture": groups samples, surfels and dome, and optionally
        mesh, probe and photographs.
    parameters
        Default `FitParameters()`.
    dictionary
        BRDFs for point lights that the surface is a mixture of; default the embedded
        59, analytic fits to measured BRDFs.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    DataTree
        A model, as the kind "model" is stored: groups fitted, basis, held_out,
        outliers, the capture's mesh, dome and probe, and translucency if there is a
        probe. Attributes: parameters, fraction of surfels per status, medians of the
        residuals and of the errors at held-out samples, lights and cameras that many
        samples contradict, "translucency" of each site (`summarise_translucency`),
        skipped parts with reasons, wall times of the stages.

    Raises
    ------
    InputError
        A capture that does not fit the schema, or whose consent does not cover fits, or
        no surfel that could be fitted.

    Examples
    --------
    >>> model = fit_model(capture, FitParameters(k=6, hold_out_lights=0.1))  # doctest: +SKIP
    """
    first = first_pass(capture, parameters, dictionary=dictionary, progress=progress)
    return second_pass(capture, first, dictionary=dictionary, progress=progress)


def first_pass(
    capture: xr.DataTree,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    progress: Progress | None = None,
) -> xr.DataTree:
    """The first half of `fit_model`: normals, diffuse reflectance and the fit by the dictionary.

    Returns
    -------
    DataTree
        Groups "fitted" and "held_out", much smaller than the capture; `second_pass` continues from
        them, if necessary in another process.
    """
    honour_consent(capture.attrs, "fit")
    parameters = parameters or FitParameters()
    clock = Clock(progress)
    whole = lumitexels(capture)
    groups: dict[str, xr.Dataset] = {}
    if parameters.light_gains:
        chosen = np.random.default_rng([parameters.seed, 2])
        with clock.stage("light gains"):
            groups["light_gains"] = estimate_light_gains(
                whole, rng=chosen, eta=parameters.eta
            )
        whole = divided_by_gains(whole, groups["light_gains"]["light_gain"])
    with clock.stage("dictionary"):
        tables = disc_dictionary(dictionary, disc_angle(whole))
        plan = plan_fit(capture, parameters, dictionary=dictionary)
    _require_components(parameters.k, len(tables.names))
    held_out = hold_out(capture, plan, parameters)
    work = fitted_part(whole, held_out)
    eta = parameters.eta
    rank = min(parameters.rank, len(tables.names))
    diffuse = partial(
        estimate_diffuse_reflectance,
        eta=eta,
        even_reflection=parameters.even_reflection,
    )

    # one graph: every block of samples is read once
    def fit(samples: xr.Dataset) -> xr.Dataset:
        found = estimate_normals(samples, eta=eta)
        found = found.merge(diffuse(samples.merge(found)))
        surface = fit_surface(
            samples.merge(found),
            dictionary=tables,
            mode=parameters.mode,
            rank=rank,
            eta=eta,
        )
        return found.merge(surface).compute()

    with clock.stage("first pass"):
        fitted = fit(work)
    if parameters.inter_reflection:
        with clock.stage("inter-reflection"):
            direct = _direct_light(capture, whole, fitted, eta)
        with clock.stage("first pass again"):
            fitted = fit(fitted_part(direct, held_out))
    fitted["fit_status"][find_obstructed(fitted)] = FitStatus.OBSTRUCTED
    fitted = fitted.assign(refractive_index=label("refractive_index", eta)).drop_vars(
        [name for name in ("light", "camera") if name in fitted.coords]
    )
    first = xr.DataTree.from_dict({"fitted": fitted, "held_out": held_out, **groups})
    first.attrs = {
        "parameters": parameters.as_dict() | {"rank": rank},
        "dictionary": tables.source,
    }
    first.attrs |= {"dictionary_digest": _digest(dictionary), "seconds": clock.seconds}
    first.attrs["skipped"] = plan.explain() if plan.omissions else []
    return first


def second_pass(
    capture: xr.DataTree,
    first: xr.DataTree,
    *,
    dictionary: Dictionary | None = None,
    progress: Progress | None = None,
) -> xr.DataTree:
    """The second half of `fit_model`: reduced basis, refit, errors at held-out samples,
    outliers, translucency.

    Parameters
    ----------
    capture, dictionary, progress
        As in `fit_model`.
    first
        From `first_pass` of this capture with this dictionary.

    Raises
    ------
    InputError
        If `first` was made with another dictionary or another number of surfels, or
        holds no fitted surfel.
    """
    honour_consent(capture.attrs, "fit")
    parameters = FitParameters.of(first.attrs)
    clock = Clock(progress)
    whole = lumitexels(capture)
    if "light_gains" in first.children:
        whole = divided_by_gains(whole, first["light_gains"].to_dataset()["light_gain"])
    tables = disc_dictionary(dictionary, disc_angle(whole))
    _require_match(first, tables.source, _digest(dictionary), whole)
    fitted = first["fitted"].to_dataset()
    held_out = first["held_out"].to_dataset()
    if parameters.inter_reflection:
        with clock.stage("inter-reflection"):
            whole = _direct_light(capture, whole, fitted, parameters.eta)
    with clock.stage("reduced basis"):
        good = int((fitted["fit_status"] == FitStatus.FITTED).sum())
        rng = np.random.default_rng([parameters.seed, 1])
        weighted = fitted.merge(whole[["surfel_area"]])
        basis = reduce_basis(
            weighted, dictionary=tables, k=max(1, min(parameters.k, good)), rng=rng
        )
    with clock.stage("second pass"):
        # only mixtures of BRDFs can be rendered
        mode: Mode = "perceptual" if parameters.mode == "paper" else parameters.mode
        known = (
            "shading_normal",
            "normal_error",
            "diffuse_reflectance",
            "diffuse_reflectance_error",
        )
        judged, outliers = refit_and_evaluate(
            whole.merge(fitted[list(known)]),
            held_out=held_out,
            basis=basis,
            mode=mode,
            eta=parameters.eta,
        )
    groups = _groups(capture, fitted.merge(judged), basis) | {
        "held_out": held_out,
        "outliers": outliers,
    }
    if "light_gains" in first.children:
        groups["light_gains"] = first["light_gains"].to_dataset()
        groups["dome"] = _with_gains(
            groups["dome"], groups["light_gains"]["light_gain"].values
        )
    if "probe" in groups:
        with clock.stage("translucency"):
            sites = fit_probe(
                groups["probe"], eta=parameters.eta, profile=parameters.profile
            )
            groups["translucency"] = sites.merge(groups["probe"][["site_position"]])
            groups["fitted"] = groups["fitted"].merge(
                translucency_map(groups["fitted"], groups["translucency"])
            )
    model = xr.DataTree.from_dict(groups)
    model.attrs = {
        name: capture.attrs[name] for name in KEPT_ATTRS if name in capture.attrs
    }
    # the value that was actually used
    used = parameters.as_dict() | {"k": basis.sizes["component"]}
    model.attrs |= {"parameters": used, "dictionary": tables.source}
    model.attrs |= {"dictionary_digest": _digest(dictionary)}
    model.attrs |= _report(groups["fitted"], held_out) | _dictionary_files(tables)
    if "translucency" in groups:
        model.attrs["translucency"] = summarise_translucency(groups["translucency"])
    if "light_gains" in groups:
        model.attrs["light_gains"] = summarise_gains(groups["light_gains"])
    model.attrs |= {
        "suspects": suspects(outliers, fitted_part(whole, held_out)),
        "skipped": first.attrs["skipped"],
    }
    model.attrs["seconds"] = {**first.attrs["seconds"], **clock.seconds}
    return model


def _require_components(k: int, most: int) -> None:
    if k > most:  # checked before the fit
        raise InputError(
            Fault(
                "k",
                f"a reduced basis of this dictionary has 1 to {most} components",
                str(k),
                "choose a smaller k",
            )
        )


def _digest(dictionary: Dictionary | None) -> str:
    """Digest of the BRDFs for point lights, which is the same for lights of all sizes."""
    return (dictionary or embedded_dictionary()).digest


def _require_match(
    first: xr.DataTree, source: str, digest: str, whole: xr.Dataset
) -> None:
    if first.attrs["dictionary_digest"] != digest:
        rule = "both passes need the same dictionary"
        cure = "give that of the first pass, or repeat it"
        raise InputError(Fault("dictionary", rule, source, cure))
    surfels = first["fitted"].sizes["surfel"]
    if surfels != whole.sizes["surfel"]:
        rule = "both passes need the same capture"
        raise InputError(
            Fault(
                "first pass",
                rule,
                f"{surfels} surfels of {whole.sizes['surfel']}",
                "repeat the first pass",
            )
        )


def _dictionary_files(tables: Dictionary) -> dict[str, Any]:
    """Notes on the files the BRDFs were read from, and their digests."""
    if not tables.origins:
        return {}
    sums = {
        name: origin.sha256
        for name, origin in zip(tables.names, tables.origins, strict=True)
    }
    return {"dictionary_notes": list(tables.notes), "dictionary_sha256": sums}


def _groups(
    capture: xr.DataTree, fitted: xr.Dataset, basis: xr.Dataset
) -> dict[str, xr.Dataset]:
    """Groups of the model: results of the fit, and groups of the capture that users of
    the model need.
    """
    surfels = capture["surfels"].to_dataset()
    fitted = fitted.merge(
        surfels[[name for name in names_of(Use.COPIED) if name in surfels]].compute()
    )
    copied = {
        name: capture[name].to_dataset().compute()
        for name in COPIED_GROUPS
        if name in capture.children
    }
    return {"fitted": fitted, "basis": basis, **copied}


def _direct_light(
    capture: xr.DataTree, samples: xr.Dataset, fitted: xr.Dataset, eta: float
) -> xr.Dataset:
    """The samples minus inter-reflections between parts of the face."""
    diffuse = fitted["diffuse_reflectance"].values
    surfels = capture["surfels"].to_dataset()
    visible = surfels["light_visible_fraction"].values
    triangles = capture["mesh"].to_dataset()["triangle"].values
    return without_bounce(
        samples,
        bounced_light(samples, diffuse, visible, triangles, eta=eta),
        diffuse,
        eta=eta,
    )


def _with_gains(dome: xr.Dataset, gain: NDArray[np.float64]) -> xr.Dataset:
    """The dome with intensities multiplied by the gains, for renderings that are
    compared with photographs.
    """
    if "light_intensity" not in dome:
        return dome
    intensity = dome["light_intensity"]
    return dome.assign(
        light_intensity=(intensity * gain[:, None]).assign_attrs(intensity.attrs)
    )


def _report(fitted: xr.Dataset, held_out: xr.Dataset) -> dict[str, Any]:
    """Fraction of surfels per status, medians of the errors over area, and held-out
    lights and cameras.
    """
    status = fitted["fit_status"].values
    skin = status != FitStatus.OBSTRUCTED
    fractions = {
        m.name.lower(): float((status == m).mean())
        for m in FitStatus
        if (status == m).any()
    }
    report: dict[str, Any] = {"surfels": int(status.size), "status": fractions}
    for name in names_of(Use.REPORTED):
        finite = (
            fitted[name].values[skin & np.isfinite(fitted[name].values)]
            if name in fitted
            else np.zeros(0)
        )
        if finite.size:
            report[name] = {
                "median": float(np.median(finite)),
                "p95": float(np.quantile(finite, 0.95)),
            }
    for dim in ("light", "camera"):
        names = (
            held_out[dim].values
            if dim in held_out.coords
            else np.arange(held_out.sizes[dim])
        )
        report[f"held_out_{dim}s"] = [
            str(name) for name in names[held_out[f"{dim}_held_out"].values > 0]
        ]
    return report

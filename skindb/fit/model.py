"""The fit of one take: every stage in order, from a capture to a model, in two passes
over the samples.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from dask.callbacks import Callback

from skindb.errors import input_error, require
from skindb.fit.albedo import estimate_in_sequence
from skindb.fit.choice import choose_corrections
from skindb.fit.corrections import (
    bounced_light,
    divided_by_gains,
    estimate_light_gains,
    summarise_gains,
    without_bounce,
)
from skindb.fit.energy import crossed_gloss, energy_prior, without_even_reflection
from skindb.fit.gloss import estimate_gloss
from skindb.fit.joint import refine_jointly
from skindb.fit.lumitexels import lumitexels, relative_reflectance, scan_error
from skindb.fit.plan import fitted_part, hold_out, plan_fit, surface_of
from skindb.fit.quality import error_of_misfit, find_obstructed, suspects
from skindb.fit.surface import fit_surface, refit_and_evaluate
from skindb.fit.translucency import fit_probe, summarise_translucency, translucency_map
from skindb.jit import reported_compilation
from skindb.parameters import FitParameters
from skindb.reflectance.block import gloss_of
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.joint import Gloss
from skindb.reflectance.kinds import surface_model
from skindb.reflectance.model import ReflectanceModel
from skindb.schema import FitStatus, Use, dataset, label, names_of
from skindb.schema.cohort import EVEN
from skindb.schema.consent import honour_consent
from skindb.schema.label import take_attrs
from skindb.threads import on_one_blas_thread
from skindb.types import Float64, Progress, silent

COMPILING = "compiling, only after an installation"
COPIED_GROUPS = ("mesh", "dome", "probe", "detail")
# of the first pass, that the second one uses
ESTIMATES = (
    "shading_normal",
    "normal_error",
    "diffuse_reflectance",
    "diffuse_reflectance_error",
)


def fit_model(
    capture: xr.DataTree,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    progress: Progress = silent,
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
        BRDFs for point lights that the surface is a mixture of; default
        `embedded_dictionary()`.
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


@on_one_blas_thread
def first_pass(
    capture: xr.DataTree,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    progress: Progress = silent,
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
    timer = StageTimer(progress)
    samples = lumitexels(capture)
    groups = {}
    with timer.stage("dictionary"):
        surface = surface_of(samples, parameters, dictionary)
        plan = plan_fit(capture, parameters, dictionary=dictionary)
    held_out = hold_out(capture, plan, parameters)
    with timer.stage("choice of corrections"):
        parameters, reasons = choose_corrections(capture, samples, held_out, parameters)
    if parameters.light_gains:
        with timer.stage("light gains"):
            gains = _training_gains(samples, held_out, parameters)
        groups["light_gains"] = gains
        samples = divided_by_gains(samples, gains["light_gain"])
    with timer.stage("first pass"):
        part = fitted_part(samples, held_out)
        gloss = estimate_gloss(part, eta=parameters.eta, scan_error=scan_error(part))
        if gloss.of_rig:
            reasons = reasons | {"gloss": "of the calibration, where samples are few"}
        fitted = _fit_surfels(part, surface, parameters, gloss)
    if parameters.inter_reflection:
        with timer.stage("inter-reflection"):
            direct = _direct_light(capture, samples, fitted, parameters.eta)
        with timer.stage("first pass again"):
            part = fitted_part(direct, held_out)
            fitted = _fit_surfels(part, surface, parameters, gloss)
    total = fitted["diffuse_reflectance_total_error"]
    total[:] = np.hypot(total.values, np.nan_to_num(error_of_misfit(fitted)))
    fitted["fit_status"][find_obstructed(fitted)] = FitStatus.OBSTRUCTED
    scalars = {
        "refractive_index": label("refractive_index", parameters.eta),
        "inter_reflection": label("inter_reflection", int(parameters.inter_reflection)),
    }
    devices = [name for name in ("light", "camera") if name in fitted.coords]
    fitted = fitted.assign(scalars).drop_vars(devices)
    first = xr.DataTree.from_dict({"fitted": fitted, "held_out": held_out, **groups})
    first.attrs = surface.provenance | {
        "parameters": parameters.as_dict() | surface.settings,
        "corrections": reasons,
        "seconds": timer.seconds,
        "skipped": plan.skipped(),
    }
    return first


def _training_gains(
    samples: xr.Dataset, held_out: xr.Dataset, parameters: FitParameters
) -> xr.Dataset:
    """Gains of the lights from the samples that are fitted. Lights that are held out have
    gain 1, so that no held-out sample contributes to its own prediction.
    """
    training = held_out["light_held_out"].values == 0
    estimated = estimate_light_gains(
        fitted_part(samples, held_out),
        rng=np.random.default_rng([parameters.seed, 2]),
        eta=parameters.eta,
    )
    gain = np.ones(training.size)
    gain[training] = estimated["light_gain"].values
    coords = {"light": samples["light"].values} if "light" in samples.coords else None
    return dataset({"light_gain": gain}, coords=coords)


def _fit_surfels(
    samples: xr.Dataset,
    surface: ReflectanceModel,
    parameters: FitParameters,
    gloss: Gloss,
) -> xr.Dataset:
    """Normal, diffuse reflectance and surface term of every surfel; one graph, in which
    every block of samples is read once.
    """
    eta = parameters.eta
    prior = scan_error(samples)
    estimates = estimate_in_sequence(samples, eta=eta, scan_error=prior)
    refined = refine_jointly(
        samples.merge(estimates), eta=eta, scan_error=prior, gloss=gloss
    )
    estimates = estimates.assign(refined)
    terms = fit_surface(
        samples.merge(estimates), surface=surface, mode=parameters.mode, eta=eta
    )
    return estimates.merge(terms).compute()


@on_one_blas_thread
def second_pass(
    capture: xr.DataTree,
    first: xr.DataTree,
    *,
    dictionary: Dictionary | None = None,
    progress: Progress = silent,
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
    timer = StageTimer(progress)
    samples = lumitexels(capture)
    gains = None
    if "light_gains" in first.children:
        gains = first["light_gains"].to_dataset()
        samples = divided_by_gains(samples, gains["light_gain"])
    surface = surface_of(samples, parameters, dictionary)
    _require_match(first, surface, samples)
    fitted = first["fitted"].to_dataset()
    held_out = first["held_out"].to_dataset()
    if parameters.inter_reflection:
        with timer.stage("inter-reflection"):
            samples = _direct_light(capture, samples, fitted, parameters.eta)
    with timer.stage("reduced basis"):
        rng = np.random.default_rng([parameters.seed, 1])
        weighted = fitted.merge(samples[["surfel_area"]])
        basis = surface.reduced(weighted, k=parameters.k, rng=rng)
    with timer.stage("second pass"):
        judged, outliers = refit_and_evaluate(
            samples.merge(fitted[list(ESTIMATES)]),
            held_out=held_out,
            basis=basis,
            mode=parameters.mode,
            eta=parameters.eta,
        )
    # a basis of four does not contain what few surfels reflect: noses would lose a sixth
    gloss = gloss_of(surface.normal_reflectance(surface.parameters_of(fitted)))
    groups = _groups(
        capture, fitted.assign(judged).assign(dataset(gloss)), basis, gains
    )
    prior = None
    if not relative_reflectance(samples):
        condition = str(capture.attrs.get("condition", "normal"))
        prior = energy_prior(condition, parameters)
    groups["fitted"], energy = without_even_reflection(
        groups["fitted"], prior, crossed_gloss(samples, parameters.eta)
    )
    groups |= {"held_out": held_out, "outliers": outliers}
    if "probe" in groups:
        with timer.stage("translucency"):
            groups |= _translucency(groups, parameters)
    model = xr.DataTree.from_dict(groups)
    # the values that were actually used
    settings = parameters.as_dict() | surface_model(basis).settings
    model.attrs = take_attrs(capture.attrs) | {"parameters": settings}
    model.attrs |= surface.provenance | _report(groups["fitted"], held_out)
    if "translucency" in groups:
        sites = groups["translucency"]
        model.attrs["translucency"] = summarise_translucency(sites)
    if gains is not None:
        model.attrs["light_gains"] = summarise_gains(gains)
    model.attrs |= {
        "surface_energy": energy,
        **{name: float(groups["fitted"][name]) for name in EVEN},
        "suspects": suspects(outliers, fitted_part(samples, held_out)),
        "corrections": first.attrs["corrections"],
        "skipped": first.attrs["skipped"],
        "relative_reflectance": relative_reflectance(samples),
        "seconds": {**first.attrs["seconds"], **timer.seconds},
    }
    return model


def _require_match(
    first: xr.DataTree, surface: ReflectanceModel, samples: xr.Dataset
) -> None:
    """Require that a first pass used this surface model and these surfels."""
    origin = surface.provenance
    if any(first.attrs.get(name) != origin[name] for name in origin):
        rule = "both passes need the same surface model and dictionary"
        cure = "give that of the first pass, or repeat it"
        source = str(next(iter(origin.values())))
        raise input_error("dictionary", rule, source, cure)
    surfels = first["fitted"].sizes["surfel"]
    require(
        surfels == samples.sizes["surfel"],
        "first pass",
        "both passes need the same capture",
        f"{surfels} surfels of {samples.sizes['surfel']}",
        "repeat the first pass",
    )


def _groups(
    capture: xr.DataTree,
    fitted: xr.Dataset,
    basis: xr.Dataset,
    gains: xr.Dataset | None,
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
    if gains is not None:
        copied["dome"] = _with_gains(copied["dome"], gains["light_gain"].values)
        copied["light_gains"] = gains
    return {"fitted": fitted, "basis": basis, **copied}


def _translucency(
    groups: Mapping[str, xr.Dataset], parameters: FitParameters
) -> dict[str, xr.Dataset]:
    """Group "translucency" with the sites of the probe, and group "fitted" with
    sigma_tr.
    """
    probe = groups["probe"]
    sites = fit_probe(probe, eta=parameters.eta)
    sites = sites.merge(probe[["site_position"]])
    fitted = groups["fitted"].merge(translucency_map(groups["fitted"], sites))
    return {"translucency": sites, "fitted": fitted}


def _direct_light(
    capture: xr.DataTree, samples: xr.Dataset, fitted: xr.Dataset, eta: float
) -> xr.Dataset:
    """The samples minus inter-reflections between parts of the face."""
    diffuse = fitted["diffuse_reflectance"].values
    surfels = capture["surfels"].to_dataset()
    visible = surfels["light_visible_fraction"].values
    triangles = capture["mesh"].dataset["triangle"].values
    return without_bounce(
        samples,
        bounced_light(samples, diffuse, visible, triangles, eta=eta),
        diffuse,
        eta=eta,
    )


def _with_gains(dome: xr.Dataset, gain: Float64) -> xr.Dataset:
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
    """Fraction of surfels per status, medians of the errors of unobstructed surfels, and
    held-out lights and cameras.
    """
    status = fitted["fit_status"].values
    skin = status != FitStatus.OBSTRUCTED
    fractions = {
        m.name.lower(): float((status == m).mean())
        for m in FitStatus
        if (status == m).any()
    }
    report = {"surfels": int(status.size), "status": fractions}
    for name in names_of(Use.REPORTED):
        if name not in fitted:
            continue
        values = fitted[name].values
        finite = values[skin & np.isfinite(values)]
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


@dataclass
class StageTimer:
    """Times stages; `progress` is called with the stage, the steps done and the total
    number of steps.
    """

    progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; the tasks of local dask schedulers are its steps, an eager
        stage is one step.
        """
        begin = time.perf_counter()
        report = self.progress
        ticker = _Ticker(name, report)
        report(name, 0, 1)
        with (
            ticker,
            reported_compilation(
                lambda: report(f"{name} ({COMPILING})", ticker.done, ticker.total)
            ),
        ):
            yield
        report(name, ticker.total, ticker.total)
        self.seconds[name] = round(time.perf_counter() - begin, 3)


class _Ticker(Callback):
    """Counts the finished tasks of the graphs that run while it is active."""

    def __init__(self, name: str, progress: Progress) -> None:
        super().__init__(start=self._begin, posttask=self._finish)  # type: ignore[no-untyped-call]
        self.name = name
        self.tell = progress
        self.total = 1
        self.done = 0

    def _begin(self, graph: Mapping[Any, Any]) -> None:
        self.total = max(len(graph), 1)
        self.done = 0

    def _finish(self, *_: Any) -> None:
        self.done = min(self.done + 1, self.total)
        self.tell(self.name, self.done, self.total)

"""Choice of the corrections of a take: each is tried on a sample of the surfels, and kept
if it improves predictions of lights and cameras that are held out for this choice alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from skindb.fit.albedo import estimate_in_sequence
from skindb.fit.corrections import (
    MIN_GAIN_SPREAD,
    bounced_light,
    divided_by_gains,
    estimate_light_gains,
    gain_spread,
    without_bounce,
)
from skindb.fit.lumitexels import directions, scan_error
from skindb.fit.plan import fitted_part, surface_of
from skindb.fit.quality import HELD_OUT_ERRORS
from skindb.fit.surface import fit_surface, held_out_error
from skindb.parameters import FitParameters
from skindb.schema import dataset
from skindb.types import Array, Index, Mask

CORRECTIONS = ("light_gains", "inter_reflection")
STREAM = 3  # of random numbers
# what a choice needs: with less, it would be made by chance
MIN_LIGHTS = 16
MIN_CAMERAS = 4
MIN_SURFELS = 300
MIN_SAMPLES = 16  # of a surfel
MAX_SURFELS = 1200  # a trial of these takes 4 % of the first pass of 30,000
# Runs of surfels that are read, since a part of a stored chunk cannot be; 20 runs are a
# seventh of the samples of 37,000 surfels.
PATCH = 256
MAX_PATCHES = 20
MAX_SURFELS_GAINS = 250
HELD_OUT_FRACTION = 0.2
# Fraction of the error that a correction must remove at lights and at cameras, and by
# more than one standard error: on six captures the wrong choice is 4 to 10 % worse,
# the right one 3 to 5 % better.
MIN_IMPROVEMENT = 0.01
MAX_LOG_RATIO = 0.5  # of one surfel, so that few do not decide
# Inter-reflection is judged where it is strongest; it is nothing on most of a face.
BOUNCED_QUANTILE = 0.75
MIN_BOUNCED = 1e-3  # of the RMS of the samples
MIN_SURFELS_BOUNCE = 50


class Change(NamedTuple):
    """Mean relative change of the errors by a correction, and its standard error."""

    mean: float
    error: float

    @property
    def improves(self) -> bool:
        """Whether the errors are smaller by the margin."""
        return self.mean < -max(self.error, MIN_IMPROVEMENT)

    def __str__(self) -> str:
        return f"{100 * self.mean:+.1f} +- {100 * self.error:.1f} %"


@dataclass(frozen=True)
class Trial:
    """Samples of a few surfels, and lights and cameras that their fit does not use."""

    capture: xr.DataTree
    samples: xr.Dataset  # of all surfels, training lights and cameras only
    lights: Index  # their indices in the capture
    surfels: Index  # indices of the sample
    held_out: xr.Dataset
    parameters: FitParameters

    def errors(self, few: xr.Dataset) -> tuple[dict[str, Array], xr.Dataset]:
        """RMS errors [sr^-1] of the surfels at held-out lights and at held-out cameras,
        and their fit, stage after stage, by one GGX lobe.
        """
        one_lobe = FitParameters(surface="ggx", eta=self.parameters.eta)
        surface = surface_of(few, one_lobe, None)
        part = fitted_part(few, self.held_out)
        eta = one_lobe.eta
        fitted = estimate_in_sequence(part, eta=eta, scan_error=scan_error(part))
        lobes = fit_surface(part.merge(fitted), surface=surface, eta=eta)
        fitted = fitted.merge(lobes)
        weighted = fitted.merge(few[["surfel_area"]])
        basis = surface.reduced(weighted, k=1, rng=np.random.default_rng(0))
        names = ("shading_normal", "diffuse_reflectance", *surface.parameter_variables)
        errors = {}
        held = {
            of: self.held_out[f"{of}_held_out"].values > 0 for of in HELD_OUT_ERRORS
        }
        for of in held:
            chosen = {dim: held[dim] == (dim == of) for dim in held}
            unseen = few.isel(chosen)
            judged = held_out_error(
                unseen.merge(fitted[list(names)]), basis=basis, eta=eta, of=of
            )
            relative = judged[HELD_OUT_ERRORS[of][0]].values
            errors[of] = relative * _rms(unseen["reflectance_sample"].values)
        return errors, fitted

    def gains(self, few: xr.Dataset) -> tuple[xr.DataArray, float]:
        """Gains of the lights, without the held-out cameras, and their standard deviation
        without what is linear over the dome, as turned normals are.
        """
        step = max(1, few.sizes["surfel"] // MAX_SURFELS_GAINS)
        cameras = np.flatnonzero(self.held_out["camera_held_out"].values == 0)
        gain = estimate_light_gains(
            few.isel(surfel=slice(0, None, step), camera=cameras),
            rng=np.random.default_rng([self.parameters.seed, STREAM]),
            eta=self.parameters.eta,
        )["light_gain"]
        middle = few["surfel_position"].values.mean(axis=0, keepdims=True)
        towards = directions(middle, few["light_position"].values)[0]
        return gain, gain_spread(np.log(gain.values), towards)

    def direct(self, few: xr.Dataset, fitted: xr.Dataset) -> xr.Dataset:
        """The samples without light from other parts of the face, whose R_d is taken to
        be the median.
        """
        found = fitted["diffuse_reflectance"].values
        diffuse = np.full((self.samples.sizes["surfel"], found.shape[1]), np.nan)
        diffuse[self.surfels] = found
        surfels = self.capture["surfels"].to_dataset()
        bounced = bounced_light(
            self.samples,
            diffuse,
            surfels["light_visible_fraction"].values[:, self.lights],
            self.capture["mesh"].dataset["triangle"].values,
            eta=self.parameters.eta,
            receivers=self.surfels,
        )
        return without_bounce(few, bounced, found, eta=self.parameters.eta)


def choose_corrections(
    capture: xr.DataTree,
    samples: xr.Dataset,
    held_out: xr.Dataset,
    parameters: FitParameters,
) -> tuple[FitParameters, dict[str, str]]:
    """Decide which corrections improve the fit of a take.

    Parameters
    ----------
    capture, samples
        Version of kind "capture", and its `lumitexels`.
    held_out
        Lights and cameras held out of the fit, which contribute nothing.
    parameters
        Only the corrections that are "auto" are chosen.

    Returns
    -------
    parameters, reasons
        The parameters without "auto", and for each choice a sentence with its reason.

    Notes
    -----
    The error at held-out lights alone prefers wrong gains to none on some captures. Gains
    must also differ by more than errors of estimates do, without what is linear over the
    dome, and must improve predictions of cameras that did not estimate them.
    """
    undecided = [name for name in CORRECTIONS if getattr(parameters, name) == "auto"]
    if not undecided:
        return parameters, {}
    # "auto" becomes off until a trial decides
    off = replace(
        parameters,
        light_gains=parameters.light_gains is True,
        inter_reflection=parameters.inter_reflection is True,
    )
    training = fitted_part(samples, held_out)
    count = capture["samples"].dataset["sample_count"].values
    patches = _patches(len(count))
    near = np.concatenate([np.arange(p.start, p.stop) for p in patches])
    usable = near[count[near] >= MIN_SAMPLES]
    lights, cameras = training.sizes["light"], training.sizes["camera"]
    enough = lights >= MIN_LIGHTS and cameras >= MIN_CAMERAS
    if not enough or len(usable) < MIN_SURFELS:
        reason = (
            f"off: a choice needs {MIN_LIGHTS} lights, {MIN_CAMERAS} cameras and "
            f"{MIN_SURFELS} surfels of {MIN_SAMPLES} samples; found "
            f"{lights}, {cameras} and {len(usable)}"
        )
        return off, dict.fromkeys(undecided, reason)
    rng = np.random.default_rng([parameters.seed, STREAM])
    surfels = np.sort(rng.permutation(usable)[:MAX_SURFELS])
    few = _read(training, patches).isel(surfel=np.searchsorted(near, surfels))
    flags = {
        f"{dim}_held_out": _drawn(few.sizes[dim], rng) for dim in ("light", "camera")
    }
    fitted = np.flatnonzero(held_out["light_held_out"].values == 0)
    trial = Trial(capture, training, fitted, surfels, dataset(flags), parameters)
    return _tried(trial, few, undecided, off)


def _patches(surfels: int) -> list[slice]:
    """Runs of surfels, evenly over the order in which they are stored."""
    last = max(surfels - 1, 0) // PATCH
    chosen = np.unique(np.linspace(0, last, min(MAX_PATCHES, last + 1)).astype(np.intp))
    return [slice(PATCH * k, min(PATCH * (k + 1), surfels)) for k in chosen.tolist()]


def _read(samples: xr.Dataset, patches: list[slice]) -> xr.Dataset:
    """The samples of runs of surfels, in memory."""
    # together, Dask would read the blocks around them
    parts = [samples.isel(surfel=patch).compute() for patch in patches]
    return xr.concat(
        parts, "surfel", data_vars="minimal", coords="minimal", compat="override"
    )


def _tried(
    trial: Trial, few: xr.Dataset, undecided: list[str], parameters: FitParameters
) -> tuple[FitParameters, dict[str, str]]:
    """The choice by trials: first of the gains, then of inter-reflection with them."""
    reasons = {}
    if "light_gains" in undecided or parameters.light_gains:
        gain, spread = trial.gains(few)
        corrected = divided_by_gains(few, gain)
    if "light_gains" in undecided:
        needed = f"{100 * MIN_GAIN_SPREAD:.0f} %"
        if spread < MIN_GAIN_SPREAD:
            reasons["light_gains"] = (
                f"off: they differ by {spread:.1%}, less than {needed}"
            )
        else:
            # lights that no fit uses have one free factor each, with and without gains
            unseen = trial.held_out["light_held_out"].values > 0
            scaled = divided_by_gains(few, gain.where(unseen, 1.0))
            before, _ = trial.errors(scaled)
            changes = _changes(before, trial.errors(corrected)[0])
            good = all(change.improves for change in changes.values())
            parameters = replace(parameters, light_gains=good)
            reasons["light_gains"] = (
                f"{_word(good)}: they differ by {spread:.1%}, {_text(changes)}"
            )
    if parameters.light_gains:
        few = corrected
    if "inter_reflection" in undecided:
        before, fitted = trial.errors(few)
        direct = trial.direct(few, fitted)
        fraction = 1 - _rms(direct["reflectance_sample"].values) / _rms(
            few["reflectance_sample"].values
        )
        limit = max(np.nanquantile(fraction, BOUNCED_QUANTILE), MIN_BOUNCED)
        strong = fraction >= limit
        if strong.sum() < MIN_SURFELS_BOUNCE:
            reasons["inter_reflection"] = "off: no part of the face lights another"
            return parameters, reasons
        changes = _changes(before, trial.errors(direct)[0], strong)
        good = all(change.improves for change in changes.values())
        parameters = replace(parameters, inter_reflection=good)
        reasons["inter_reflection"] = f"{_word(good)}: {_text(changes)}"
    return parameters, reasons


def _changes(
    before: dict[str, Array],
    after: dict[str, Array],
    chosen: Mask | None = None,
) -> dict[str, Change]:
    """Change of the errors at lights and at cameras, a mean over surfels."""
    changes = {}
    for of, errors in before.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(after[of] / errors)
        usable = np.isfinite(ratio) if chosen is None else np.isfinite(ratio) & chosen
        logs = np.clip(ratio[usable], -MAX_LOG_RATIO, MAX_LOG_RATIO)
        changes[of] = Change(0.0, np.inf)
        if logs.size > 1:
            error = logs.std(ddof=1) / np.sqrt(logs.size)
            changes[of] = Change(float(logs.mean()), float(error))
    return changes


def _text(changes: dict[str, Change]) -> str:
    lights, cameras = changes["light"], changes["camera"]
    return f"errors change by {lights} at held-out lights, {cameras} at cameras"


def _word(good: bool) -> str:
    return "on" if good else "off"


def _rms(values: Array) -> Array:
    """RMS (surfel,) of the finite samples (surfel, light, camera, channel); 0 without any."""
    finite = np.isfinite(values)
    square = np.square(np.where(finite, values, 0), dtype=np.float64).sum(
        axis=(1, 2, 3)
    )
    return np.sqrt(square / np.maximum(finite.sum(axis=(1, 2, 3)), 1))


def _drawn(count: int, rng: np.random.Generator) -> Mask:
    """A random fraction of lights or cameras."""
    held = np.zeros(count, np.bool_)
    held[rng.permutation(count)[: max(1, round(HELD_OUT_FRACTION * count))]] = True
    return held

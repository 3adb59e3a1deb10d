"""Calibration of a rig from its own fitted takes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from xarray import Dataset, DataTree

from skindb.analysis.regions import own_masks
from skindb.calibration.lights import is_same_rig, moved_lights, rig_lobes
from skindb.errors import input_error, require
from skindb.fit.corrections import MIN_GAIN_SPREAD
from skindb.fit.gloss import common_lobes, take_gloss
from skindb.fit.lumitexels import lumitexels
from skindb.fit.rig import (
    MIN_TAKES,
    common_camera_gains,
    common_light_errors,
    take_residuals,
)
from skindb.format.fields import NAME
from skindb.schema import variables
from skindb.store import CALIBRATION, Database, Record, require_text
from skindb.types import Float64, Progress, silent
from skindb.workflow.audit import logged_action
from skindb.workflow.captures import RIG, require_kind_of_calibration, takes_of_earlier
from skindb.workflow.fit import current_model, takes_without_consent

# figure of the description: variable, of which it is the largest value
FIGURES = {
    "largest_relative_error": variables.RIG_LIGHT_GAIN_ERROR,
    "largest_angle_error": variables.RIG_LIGHT_ANGLE_ERROR,
    "spread": variables.RIG_SPREAD,
    "spread_left": variables.RIG_SPREAD_LEFT,
    "camera_spread": variables.RIG_CAMERA_SPREAD,
    "camera_spread_left": variables.RIG_CAMERA_SPREAD_LEFT,
}


def calibrate_rig(
    db: Database,
    takes: Sequence[str] = (),
    *,
    name: str,
    seed: int = 0,
    progress: Progress = silent,
) -> Record:
    """Estimate the errors of intensity and direction of the lights, and of the sensitivity
    of the cameras, that all takes of a rig have in common, and the lobes of the skin of
    takes with many samples, and commit them as the next version of the calibration of
    that name.

    A take that is ingested later without the name of a calibration, with the same lights,
    uses them. What the takes themselves were ingested with is taken into account.

    Parameters
    ----------
    db
        Database with fitted takes of the rig.
    takes
        Names of takes; default all whose newest capture is fitted, and whose subjects
        consent to fits.
    name
        Name of the calibration.
    seed
        Random seed of the surfels that are used.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    Record
        Of the commit; the version has the group "rig_calibration".

    Raises
    ------
    InputError
        If there are fewer than three takes, if they are not of one rig or not fitted, or
        if the common gains do not predict a held-out take and fewer than three takes have
        many samples. Nothing is stored then.
    """
    key = require_text(name, NAME.pattern, "name of a calibration")
    require_kind_of_calibration(db, key, rig=True)
    models = _models(db, takes)
    require(
        len(models) >= MIN_TAKES,
        "calibration from takes",
        f"at least {MIN_TAKES} takes must have a model of their newest capture",
        ", ".join(models) or "none",
        "ingest and fit more takes of the rig",
    )
    inputs = []
    residuals = []
    cameras = []
    gloss = []
    positions = dict[str, Float64]()
    for number, (take, model) in enumerate(models.items()):
        progress("lights", number, len(models))
        record = db.record("capture", take)
        capture = db.version(record)
        lights = _lights(record, capture)
        positions = positions or lights
        _require_rig(positions, lights, take=take, first=next(iter(models)))
        positions = lights | positions
        rng = np.random.default_rng([seed, number])
        fitted = db.version(model)
        own, camera_gains = take_residuals(capture, fitted, rng=rng)
        residuals.append((own, lights))
        cameras.append(camera_gains)
        if "statistics" in db.consent(take):
            eta = float(fitted["fitted"][variables.REFRACTIVE_INDEX])
            regions = own_masks(capture["surfels"].dataset)
            gloss.append(take_gloss(lumitexels(capture), eta=eta, regions=regions))
        inputs += [record, model]
    names = [*positions]
    group = common_light_errors(
        [
            own.of_lights([names.index(light) for light in lights], len(names))
            for own, lights in residuals
        ],
        lights=names,
        positions=np.array([*positions.values()]),
    )
    group = group.merge(common_camera_gains(cameras)).merge(common_lobes(gloss))
    _require_help(group)
    progress("lights", len(models), len(models))
    provenance = {
        "command": "calibrate",
        "parameters": {"takes": [*models]},
        "seeds": {"calibrate": seed},
        "inputs": [record.as_input() for record in inputs],
    }
    stage = db.stage(CALIBRATION, key, names=[*models])
    with logged_action(db, "calibrate", [*models]), stage:
        stage.write({RIG: group})
        return stage.commit(provenance)


def describe_rig(db: Database, record: Record) -> dict[str, Any]:
    """Gains and directions of the lights and gains of the cameras of a calibration from
    takes: their spread, errors, and the spread that they leave in a held-out take.
    """
    stored = db.version(record)
    rig = stored[RIG].dataset.load()
    count = rig[variables.RIG_TAKES].values
    few = rig["light"].values[count < MIN_TAKES]
    position = rig[variables.RIG_LIGHT_POSITION].values
    turns = rig[variables.RIG_LIGHT_OFFSET].values
    turns = turns / np.linalg.norm(position, axis=1, keepdims=True)
    uncorrected = {
        take
        for take in record.provenance["parameters"]["takes"]
        if db.has("capture", take)
        and not db.record("capture", take).provenance.get("calibrated_by")
    }
    figures = {name: float(rig[variable].max()) for name, variable in FIGURES.items()}
    return figures | {
        "lights": rig.sizes["light"],
        "takes": record.provenance["parameters"]["takes"],
        "light_gains": bool((rig[variables.RIG_LIGHT_GAIN] != 1).any()),
        "cameras": rig.sizes["camera"],
        "camera_gains": bool((rig[variables.RIG_CAMERA_GAIN] != 1).any()),
        "misfit": rig[variables.RIG_MISFIT].to_series().to_dict(),
        "lobes": rig_lobes(rig),
        "angle": float(np.degrees(np.sqrt(np.square(turns).sum(axis=1).mean()))),
        "without_gain": [str(light) for light in few],
        "ingest_again": sorted(uncorrected.union(takes_of_earlier(db, record))),
    }


def _models(db: Database, takes: Sequence[str]) -> dict[str, Record]:
    """The models of the takes, or of all that can be used."""
    if not takes:
        refused = takes_without_consent(db)
        allowed = [take for take in db.takes("model") if take not in refused]
        models = {take: current_model(db, take) for take in allowed}
        return {take: model for take, model in models.items() if model is not None}
    found = {}
    for take in takes:
        db.record("capture", take)
        model = current_model(db, take)
        if model is None:
            raise input_error(
                take,
                "a calibration needs a model of the newest capture",
                "none",
                "run skindb fit first",
            )
        found[take] = model
    return found


def _lights(record: Record, capture: DataTree) -> dict[str, Float64]:
    """Stated position (3,) mm of each light of a capture, whose intensities must be its own."""
    take = record.take
    rule = "a calibration from takes needs captures with a dome"
    require("dome" in capture.children, take, rule, "none", "name other takes")
    dome = capture["dome"].dataset
    is_from_setup = (
        record.provenance.get("calibrated_by")
        and variables.LIGHT_GAIN_APPLIED not in dome
        and variables.CAMERA_GAIN_APPLIED not in dome
        and variables.LOBE_STRENGTH_APPLIED not in capture["surfels"]
    )
    require(
        not is_from_setup,
        take,
        "takes of a rig must have intensities of their own or of a calibration from takes",
        f"those of calibration {record.provenance.get('calibration')}",
        "name other takes",
    )
    positions = dome[variables.LIGHT_POSITION].values.astype(np.float64)
    if variables.LIGHT_OFFSET_APPLIED in dome:
        positions = positions - dome[variables.LIGHT_OFFSET_APPLIED].values
    return dict(zip(map(str, dome["light"].values), positions, strict=True))


def _require_rig(
    positions: dict[str, Float64],
    lights: dict[str, Float64],
    *,
    take: str,
    first: str,
) -> None:
    """Require the lights of another take of the rig."""
    if is_same_rig(positions, lights):
        return
    moved = moved_lights(positions, lights)
    raise input_error(
        take,
        f"takes of one rig must have most of the lights of {first}, at the same places",
        f"light {moved[0]} elsewhere"
        if moved
        else f"{len(positions.keys() & lights.keys())} of its {len(lights)} lights in both",
        "name the takes of one rig",
    )


def _require_help(group: Dataset) -> None:
    """Require lights or cameras that are not as stated, or lobes."""
    if (
        (group[variables.RIG_LIGHT_GAIN] != 1).any()
        or (group[variables.RIG_LIGHT_OFFSET] != 0).any()
        or (group[variables.RIG_CAMERA_GAIN] != 1).any()
        or np.isfinite(group[variables.RIG_LOBE_STRENGTH]).any()
    ):
        return
    spread = float(group[variables.RIG_SPREAD])
    left = float(group[variables.RIG_SPREAD_LEFT])
    require(
        np.isfinite(spread),
        "calibration from takes",
        f"{MIN_TAKES} takes must have lights in common that their models see",
        "none",
        "fit takes with more samples",
    )
    require(
        left < spread,
        "calibration from takes",
        "common gains must lower the spread of the lights in a held-out take",
        f"{spread:.1%} without them and {left:.1%} with them",
        "nothing was stored: more takes may help, or the intensities are good as they are",
    )
    raise input_error(
        "calibration from takes",
        f"the lights must differ by {MIN_GAIN_SPREAD:.0%}, which errors of the estimate "
        "reach, without what is linear over the dome",
        f"{spread:.1%}",
        "nothing was stored: the intensities are good as they are",
    )

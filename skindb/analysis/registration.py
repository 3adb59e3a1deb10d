"""Registration: warps of takes to common (u, v) by their landmarks (Weyrich et al.
2005, section 10.2).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from xarray import Dataset, DataTree

from skindb.errors import counted, require
from skindb.geometry.atlas import signed_areas
from skindb.geometry.landmarks import mean_shape
from skindb.geometry.mesh import closest_on_mesh
from skindb.geometry.warp import (
    ALIGNED,
    Sheet,
    Warp,
    anchor_vertices,
    apply_warp,
    corresponding_uv,
    fit_warp,
    left_out_error,
)
from skindb.schema import dataset, fitted_of, variables
from skindb.schema.consent import honour_consent
from skindb.schema.notes import Note, note
from skindb.types import Array, Float64, Index, finite_rows, float64, lengths

Takes = Mapping[str, DataTree]
Registered = Mapping[str, Dataset]
MEAN = "mean"
# a landmark is doubtful if its prediction error [mm], its ratio to the error in other
# takes, and its ratio to the largest error of its own take are above these
DOUBTFUL_ERROR = 5.0
DOUBTFUL_RATIO = 3.0
DOUBTFUL_FRACTION = 0.7
IMPOSSIBLE_ERROR = 20.0  # mm, more than faces can differ
# minimum number of landmarks of the template, as a fraction of the largest number in a
# take
TEMPLATE_FRACTION = 0.75


def register(
    models: Takes, *, reference: str | None = None, smoothing: float | None = None
) -> dict[str, Dataset]:
    """Common texture coordinates of takes that have landmarks; takes without landmarks are omitted.

    The landmarks of a face do not constrain ears, neck and scalp. There, corresponding
    points on the surface of a template are used in addition (see
    `warp.corresponding_uv`). The template is the reference, or the take that shows
    most of its head.

    Parameters
    ----------
    models
        Take -> version of kind "model".
    reference
        Take whose coordinates are the common ones. By default these are given by the
        mean landmarks of all takes, after rotation, scale and translation are removed.
    smoothing
        See `fit_warp`.

    Returns
    -------
    dict
        Take -> `common_uv`, `common_landmark`, `landmark_residual`,
        `landmark_prediction_error`, `landmark_used`. Attributes describe the warp:
        `warp_kind`, `warp_smoothing`, `warp_anchors`, `warp_flips`
        (number of flipped triangles), `reference` and `template`. `mm_per_uv` is the
        scale of the common coordinates, from the distances of the landmarks.
    """
    takes = {take: model for take, model in models.items() if has_landmarks(model)}
    for take, model in takes.items():
        honour_consent({**model.attrs, "take": take}, "statistics")
    outlines = {take: outline(model) for take, model in takes.items()}
    frame = common_frame(outlines, reference=reference, smoothing=smoothing)
    if frame is None:
        return {}
    template = takes[frame.template]
    return {
        take: register_one(take, model, template, frame)
        for take, model in takes.items()
    }


@dataclass(frozen=True)
class Outline:
    """Landmarks and area of a take before registration; small, so that those of all
    takes fit into memory.
    """

    names: tuple[str, ...]  # of the landmarks
    landmark: Float64  # (k, 3) mm
    landmark_uv: Float64  # (k, 2)
    area: float  # mm2
    alignable: bool  # whether the surface can be aligned with a template

    def with_names(self, names: Sequence[str]) -> Outline:
        """The outline with the landmarks of all takes."""
        return replace(
            self,
            names=tuple(names),
            landmark=_arranged(self.landmark, self.names, names),
            landmark_uv=_arranged(self.landmark_uv, self.names, names),
        )


@dataclass(frozen=True)
class Frame:
    """The common coordinates: positions of the landmarks, and the template take."""

    names: tuple[str, ...]  # of the landmarks
    # take -> (k, 2) landmarks in the (u, v) of the take
    at: Mapping[str, Float64]
    target: Float64  # (k, 2) landmarks in the common (u, v)
    template: str
    reference: str
    smoothing: float | None


def outline(model: DataTree) -> Outline:
    """Outline of a take, the input of `common_frame`."""
    names, _ = _landmarks(model)
    sheet = _sheet(model, names)
    uv = _landmark_uv(sheet)
    return Outline(names, float64(sheet.landmark), uv, sheet.area(), sheet.alignable())


def common_frame(
    outlines: Mapping[str, Outline],
    *,
    reference: str | None = None,
    smoothing: float | None = None,
) -> Frame | None:
    """Common coordinates of the takes; None without takes.

    Parameters
    ----------
    outlines
        Take -> its `outline`, for takes with landmarks.
    reference, smoothing
        See `register`.
    """
    require(
        reference is None or reference in outlines,
        f"reference {reference}",
        "must be a take with landmarks",
        "another name",
        f"choose from takes with landmarks: {', '.join(outlines) or 'none'}",
    )
    if not outlines:
        return None
    names = tuple(dict.fromkeys(n for shape in outlines.values() for n in shape.names))
    aligned = {take: shape.with_names(names) for take, shape in outlines.items()}
    at = {take: shape.landmark_uv for take, shape in aligned.items()}
    target = at[reference] if reference else mean_shape(np.stack([*at.values()]))
    template = reference or _template_take(aligned, target)
    return Frame(names, at, target, template, reference or MEAN, smoothing)


def register_one(
    take: str, model: DataTree, template: DataTree, frame: Frame
) -> Dataset:
    """Common texture coordinates of one take; see `register`."""
    sheet = _sheet(model, frame.names)
    fit = partial(fit_warp, target=frame.target, smoothing=frame.smoothing)
    warp = fit(frame.at[frame.template])
    if take != frame.template:
        template_sheet = _sheet(template, frame.names)
        chosen = anchor_vertices(template_sheet)
        weak = (
            corresponding_uv(template_sheet, chosen, sheet),
            apply_warp(warp, template_sheet.uv[chosen]),
        )
        warp = fit(frame.at[take], weak=weak)
    return _registration_dataset(sheet, take, frame, warp)


def _template_take(outlines: Mapping[str, Outline], target: Array) -> str:
    """The take with which most others can be aligned.

    Among several, it is the one that shows most of its head, of those with many landmarks.
    """
    has_landmark = {take: finite_rows(row.landmark) for take, row in outlines.items()}
    sound = [take for take in outlines if outlines[take].alignable] or [*outlines]
    served = {
        take: sum(
            (has_landmark[take] & row).sum() >= ALIGNED for row in has_landmark.values()
        )
        for take in sound
    }
    best = [take for take in sound if served[take] == max(served.values())]
    largest_count = max(has_landmark[take].sum() for take in best)
    many = [
        take
        for take in best
        if has_landmark[take].sum() >= TEMPLATE_FRACTION * largest_count
    ]
    visible_area = {
        take: outlines[take].area / _mm_per_uv(outlines[take].landmark, target) ** 2
        for take in many
    }
    return max(visible_area, key=lambda take: np.nan_to_num(visible_area[take]))


def _sheet(model: DataTree, names: Sequence[str]) -> Sheet:
    """Surface of a take and its landmarks (k, 3); NaN for landmarks that the take lacks."""
    own, places = _landmarks(model)
    return Sheet.of(*surface_of(model), _arranged(places, own, names))


def _landmarks(model: DataTree) -> tuple[tuple[str, ...], Float64]:
    """Names of the landmarks of a take, and their positions (k, 3) [mm]."""
    points = model["mesh"].dataset[variables.LANDMARK_POSITION]
    return tuple(map(str, points["landmark"].values)), float64(points.values)


def _arranged(values: Array, own: Sequence[str], names: Sequence[str]) -> Float64:
    """Values (own, c) in the order of `names`; NaN for others."""
    out = np.full((len(names), values.shape[1]), np.nan)
    out[[names.index(name) for name in own]] = values
    return out


def _landmark_uv(sheet: Sheet) -> Float64:
    """Texture coordinates (k, 2) of the surface points nearest to the landmarks; NaN
    for landmarks that are missing.
    """
    is_known = sheet.known()
    face, corner, _ = closest_on_mesh(
        sheet.position, sheet.faces, sheet.landmark[is_known]
    )
    out = np.full((len(is_known), 2), np.nan)
    out[is_known] = interpolate(sheet.uv, sheet.faces[face], corner)
    return out


def _mm_per_uv(landmark: Array, target: Array) -> float:
    """Ratio of the spread of landmarks (k, 3) in mm to their spread (k, 2) in common
    (u, v); NaN for fewer than 2.
    """
    is_known = finite_rows(landmark) & finite_rows(target)
    if is_known.sum() < 2:
        return float("nan")
    face, flat = (
        float(np.sqrt(points[is_known].var(axis=0).sum()))
        for points in (landmark, target)
    )
    return face / flat if flat > 0 else float("nan")


def has_landmarks(model: DataTree) -> bool:
    """Whether a take has at least one landmark."""
    mesh = model["mesh"].data_vars if "mesh" in model.children else {}
    if variables.LANDMARK_POSITION not in mesh:
        return False
    return bool(finite_rows(_landmarks(model)[1]).any())


def _registration_dataset(sheet: Sheet, take: str, frame: Frame, warp: Warp) -> Dataset:
    """Common coordinates of a take and the quality of its warp."""
    source = frame.at[take]
    target = frame.target
    common = apply_warp(warp, sheet.uv).astype(np.float32)
    turned = (signed_areas(common, sheet.faces) < 0) & (
        signed_areas(sheet.uv, sheet.faces) >= 0
    )
    # anchors near a landmark depend on its position; the prediction error must be independent of it
    alone = fit_warp(source, target, smoothing=warp.smoothing)
    anchors = 0 if warp.spline is None else int((warp.spline.loose > 1).sum())
    return dataset(
        {
            variables.COMMON_UV: common,
            variables.COMMON_LANDMARK: target,
            variables.LANDMARK_RESIDUAL: lengths(apply_warp(warp, source) - target),
            variables.LANDMARK_PREDICTION_ERROR: left_out_error(alone),
            variables.LANDMARK_USED: warp.used.astype(np.int8),
            variables.MM_PER_UV: _mm_per_uv(sheet.landmark, target),
        },
        coords={"landmark": frame.names},
        attrs={
            "reference": frame.reference,
            "template": frame.template,
            "warp_kind": warp.kind,
            "warp_smoothing": warp.smoothing,
            "warp_anchors": anchors,
            "warp_flips": int(turned.sum()),
        },
    )


def tabulate_registration(registered: Registered) -> tuple[list[str], list[list[Any]]]:
    """Header and one row per take: its warp, prediction errors of the landmarks [mm],
    and number of further anchors.
    """
    header = (
        "take warp landmarks smoothing misfit_mm predicted_mm worst_mm worst anchors"
    ).split()
    rows = []
    for take, registration in registered.items():
        scale = float(registration[variables.MM_PER_UV])
        misfit, error = (
            scale * registration[f"landmark_{name}"].values
            for name in ("residual", "prediction_error")
        )
        attrs = registration.attrs
        # a single take has no other to compare with
        is_known = np.isfinite(error).any() and len(registered) > 1
        misfit = misfit[np.isfinite(misfit)] if len(registered) > 1 else misfit[:0]
        worst = int(np.nanargmax(error)) if is_known else 0
        rows.append(
            [
                take,
                attrs["warp_kind"],
                int(registration[variables.LANDMARK_USED].sum()),
                float(attrs["warp_smoothing"]),
                float(misfit.max()) if misfit.size else np.nan,
                float(np.nanmedian(error)) if is_known else np.nan,
                float(error[worst]) if is_known else np.nan,
                str(registration["landmark"].values[worst]) if is_known else "-",
                "template" if attrs.get("template") == take else attrs["warp_anchors"],
            ]
        )
    return header, rows


def doubtful_landmarks(registered: Registered) -> list[Note]:
    """Notes on takes with landmarks that may be misplaced, swapped or misnamed, at most
    two for each take.

    A landmark is doubtful if the other landmarks of its take predict it with a much
    larger error than in other takes. Errors are compared by landmark, because some
    landmarks, such as those of the jaw, are less predictable than others. Errors of
    neighbours that a misplaced landmark causes are not reported.
    """
    errors = {
        take: float(registration[variables.MM_PER_UV])
        * registration[variables.LANDMARK_PREDICTION_ERROR].values
        for take, registration in registered.items()
    }
    notes = []
    for take, error in errors.items():
        count = int(registered[take][variables.LANDMARK_USED].sum())
        if count > 3 and registered[take].attrs["warp_kind"] != "thin plate":
            reason_of_map = "left and right may be swapped, or they may lie on a line"
            notes.append(
                note(
                    take,
                    f"no map without folds fits its {count} landmarks; {reason_of_map}",
                )
            )
        other_errors = [e for name, e in errors.items() if name != take]
        if not other_errors or not np.isfinite(error).any():
            continue
        # a landmark that no other take has is compared with the other landmarks of its take
        alone = np.nanmedian(error)
        usual = np.array(
            [
                np.nanmedian(column) if np.isfinite(column).any() else alone
                for column in np.transpose(other_errors)
            ]
        )
        # a gross error bends the mean and appears in all takes: only the take with the
        # largest error is reported
        worst = np.nanmax([error, *other_errors], axis=0, initial=0.0)
        unlike = (error > DOUBTFUL_RATIO * usual) | (
            (error > IMPOSSIBLE_ERROR) & (error >= worst)
        )
        limit = max(DOUBTFUL_ERROR, DOUBTFUL_FRACTION * np.nanmax(error))
        odd = unlike & (error > limit)
        names = registered[take]["landmark"].values
        doubts = [
            f"{names[i]} by {error[i]:.1f} mm (other takes {usual[i]:.1f})"
            for i in np.flatnonzero(odd)
        ]
        if doubts:
            reason = (
                "check landmarks that differ from the prediction of the others: "
                f"{', '.join(doubts)}"
            )
            notes.append(note(take, reason))
    return notes


def describe_registration(registered: Registered, takes: Iterable[str]) -> list[Note]:
    """Notes on a registration for the report of a study that uses it."""
    if not registered:
        reason = "no take has landmarks; only the regions of the captures are available"
        return [note("", reason)]
    _, rows = tabulate_registration(registered)
    kinds = ", ".join(sorted({str(row[1]) for row in rows}))
    most = max(row[2] for row in rows)
    line = f"{counted(len(rows), 'take')} with up to {most} landmarks ({kinds})"
    notes = doubtful_landmarks(registered)
    measured = [row for row in rows if np.isfinite(row[6])]
    if measured:
        worst = max(measured, key=lambda row: row[6])
        middle = float(np.median([row[5] for row in measured]))
        line += (
            f"; error of a landmark predicted by the others: median {middle:.1f} mm, "
            f"largest {worst[6]:.1f} mm"
        )
        notes.insert(0, note(worst[0], f"the largest error is that of {worst[7]}"))
    without = [note(take, "no landmarks") for take in takes if take not in registered]
    return [note("", line), *notes, *without]


def surface_of(
    model: DataTree,
) -> tuple[Float64, Float64, Index]:
    """Positions (n, 3) in mm, texture coordinates (n, 2) and triangles (f, 3) of a take."""
    fitted = fitted_of(model)
    faces = model["mesh"].dataset[variables.TRIANGLE].values
    position, uv = (
        fitted[name].values.astype(float)
        for name in (variables.SURFEL_POSITION, variables.SURFEL_UV)
    )
    return position, uv, faces.astype(int)


def interpolate(values: Array, corners: Index, corner: Array) -> Float64:
    """Values (n, c) at barycentric coordinates `corner` (n, 3) of triangles with the
    vertices `at` (n, 3).
    """
    return np.asarray(np.einsum("nk,nkc->nc", corner, values[corners].astype(float)))

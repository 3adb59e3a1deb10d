"""The report of the demo: pictures, errors against the truth, population, run times."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb._version import __version__
from skindb.analysis import plot_albedo, plot_basis_size, plot_translucency
from skindb.analysis.tabulate import tabulate_study
from skindb.demo import page as report
from skindb.geometry.rays import RayScene
from skindb.optics.brdf_table import directional_albedo
from skindb.render.direct import View, shade_view, trace_view
from skindb.render.image import auto_exposure, encode_srgb, tone_map
from skindb.render.photographs import Comparison, side_by_side
from skindb.render.picture import frontal_camera
from skindb.render.scene import Lights, Surface, cameras_from_dome, from_model, lights_from_dome
from skindb.virtual.truth import Recovery

Image = NDArray[np.floating[Any]]
Progress = Callable[[str, int, int], None]
SHOWN = 220  # pixels of a picture's width
ERRORS = (  # maps of what the model does not explain, black where nothing is known
    ("held_out_error", 0.2, "error under lights the fit did not see"),
    ("outlier_fraction", 0.1, "samples the model does not explain"),
)
KEY_LIGHTS = ((-0.5, 0.35, 0.8), (0.55, 0.25, 0.8))  # where the two lights of a portrait stand


@dataclass
class Results:
    """What the report shows."""

    models: dict[str, xr.DataTree] = field(default_factory=dict)
    fits: dict[str, dict[str, Any]] = field(default_factory=dict)
    recovered: dict[str, Recovery] = field(default_factory=dict)
    compared: dict[str, list[Comparison]] = field(default_factory=dict)
    studies: dict[str, xr.DataTree] = field(default_factory=dict)
    edits: dict[float, xr.DataTree] = field(default_factory=dict)
    edited_take: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of a stage."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def in_order(self, takes: Sequence[str]) -> None:
        """Put the takes, which other processes made in any order, into the order given."""
        for name in ("models", "fits", "recovered", "compared"):
            found = getattr(self, name)
            setattr(self, name, {take: found[take] for take in takes if take in found})

    def add(self, other: Results) -> None:
        """Add what another process found."""
        for name in ("models", "fits", "recovered", "compared"):
            getattr(self, name).update(getattr(other, name))
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def write_report(path: Path, results: Results, *, progress: Progress) -> Path:
    """Write the page; returns its path."""
    sections: list[tuple[str, list[str]]] = []
    parts: tuple[tuple[str, Callable[[Results], list[str]]], ...] = (
        ("Subjects", _subjects),
        ("Maps", _maps),
        ("Photographed and predicted", _predicted),
        ("Recovered and true", _recovered),
        ("Translucency", _translucency),
        ("How many basis BRDFs", _basis_size),
        ("Albedo", _albedo),
        ("A trait added", _trait),
        ("Time", _time),
    )
    for i, (name, make) in enumerate(parts):
        progress("report", i, len(parts))
        if blocks := make(results):
            sections.append((name, blocks))
    total = time.monotonic() - results.began
    lead = (
        f"{len(results.models)} virtual takes, photographed one light at a time, touched by a virtual probe, fitted, "
        f"analysed and edited by skindb {__version__} in {total / 60:.1f} minutes. Their truth is known: every error "
        "below is measured."
    )
    path.write_text(report.page("skindb: measured faces", lead, sections), encoding="utf-8")
    progress("report", len(parts), len(parts))
    return path


def _frontal(model: xr.DataTree, *, scale: float = 1.6) -> tuple[Surface, View, RayScene, xr.Dataset]:
    dome = model["dome"].to_dataset().load()
    surface = from_model(model, fill=True)
    scene = RayScene(surface.vertices, surface.faces)
    camera = cameras_from_dome(dome)[frontal_camera(dome)].scaled(scale)
    return surface, trace_view(surface, camera, samples=2, scene=scene), scene, dome


def _key(dome: xr.Dataset) -> Lights:
    """Two lights of the dome, one from each side."""
    place = dome["light_position"].values
    place = place / np.linalg.norm(place, axis=1, keepdims=True)
    wanted = np.array(KEY_LIGHTS) / np.linalg.norm(KEY_LIGHTS, axis=1, keepdims=True)
    return lights_from_dome(dome).select(np.argmax(wanted @ place.T, axis=1))


def portrait(model: xr.DataTree, *, terms: tuple[str, ...] = ("diffuse", "surface")) -> Image:
    """The model from the front under two lights, linear."""
    surface, view, scene, dome = _frontal(model)
    return np.asarray(shade_view(view, surface, _key(dome), scene, terms=terms).sum(axis=0))


def _crop(picture: NDArray[np.uint8], mask: NDArray[np.bool_], margin: int = 6) -> NDArray[np.uint8]:
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        return picture
    top, left = max(rows[0] - margin, 0), max(cols[0] - margin, 0)
    return np.ascontiguousarray(picture[top : rows[-1] + margin, left : cols[-1] + margin])


def _subjects(results: Results) -> list[str]:
    images = {take: portrait(model) for take, model in results.models.items()}
    exposure = min(auto_exposure(image) for image in images.values())  # one for all: skin tones compare
    figures = [
        report.picture(
            _crop(tone_map(image, exposure=exposure), image.sum(axis=2) > 0),
            f"{take}: {_who(results.models[take])}",
            width=SHOWN,
        )
        for take, image in images.items()
    ]
    text = "The fitted models, from the front under two lights of the dome, all at one exposure."
    return [report.paragraph(text), report.row(figures)]


def _who(model: xr.DataTree) -> str:
    traits = dict(model.attrs.get("traits", {}))
    words = [str(traits.get(k)) for k in ("age", "gender", "ancestry") if k in traits]
    return ", ".join([*words, str(model.attrs.get("condition", "normal"))]).replace("_", " ")


def _maps(results: Results) -> list[str]:
    text = (
        "What was fitted, seen from the front. In the map of the translucency red, green and blue are 1/sigma_tr of "
        "the three channels. Points that no camera sees lit have no value and are black."
    )
    rows = [report.paragraph(text)]
    for take, model in results.models.items():
        shown = map_pictures(model)
        width = 4 * SHOWN // max(len(shown), 4) - 8  # a take in one row
        rows.append(report.row(report.picture(image, f"{take}: {text}", width=width) for image, text in shown))
    return rows


def map_pictures(model: xr.DataTree) -> list[tuple[NDArray[np.uint8], str]]:
    """Normal, albedo, surface reflection, translucency and errors of a model from the front, each with its caption."""
    surface, view, _, _ = _frontal(model, scale=1.2)
    mask = view.coverage > 0.5
    shine = view.interpolate(surface.weights) @ directional_albedo(surface.tables, [1.0])[0]
    pictures = [
        ((view.interpolate(surface.normals) + 1) / 2, "normal"),
        (encode_srgb(view.interpolate(surface.diffuse)), "diffuse albedo"),
        (_scaled(shine, 0.12), "surface reflection at normal incidence, 0 to 0.12"),
    ]
    if surface.sigma_tr is not None:
        depth = np.clip(1 / view.interpolate(surface.sigma_tr) / 3, 0, 1)
        pictures.append((encode_srgb(depth), "translucency 1/sigma_tr, 0 to 3 mm"))
    fitted = model["fitted"].to_dataset()
    for name, top, text in ERRORS:
        if name in fitted:
            found = view.interpolate(np.nan_to_num(fitted[name].values)[:, None])[:, 0]
            pictures.append((_scaled(found, top), f"{text}, 0 to {top:.0%}"))
    return [(_crop(_byte(view.image(values)), mask), text) for values, text in pictures]


def _scaled(values: Image, top: float) -> Image:
    return np.repeat(np.clip(values / top, 0, 1)[:, None], 3, axis=1)


def _byte(image: Image) -> NDArray[np.uint8]:
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _predicted(results: Results) -> list[str]:
    text = (
        "Threes of pictures: a photograph as taken, the model's prediction of it, and their difference ten times "
        "enlarged (grey is none), each three at its own exposure. Lights marked 'held out' were not used by the fit. "
        "Errors are over all pixels of the face, folds and shadow edges included; the table of recovered values below "
        "has the median over its fitted points."
    )
    figures, rows = [], []
    for take, found in results.compared.items():
        best = sorted(found, key=lambda c: not c.held_out)[:1]
        figures += [report.picture(_cropped_row(one), _caption(take, one), width=3 * SHOWN // 2 + 150) for one in best]
        rows += [[take, c.light, c.camera, "yes" if c.held_out else "no", *_errors(c)] for c in found]
    header = ["take", "light", "camera", "held out", "relative RMSE", "PSNR [dB]", "SSIM", "median delta E"]
    return [report.paragraph(text), report.row(figures), report.table(header, rows)]


def _errors(one: Comparison) -> list[float]:
    return [one.error[name] for name in ("relative_rmse", "psnr", "ssim", "delta_e_median")]


def _caption(take: str, one: Comparison) -> str:
    held = "held out" if one.held_out else "seen by the fit"
    return f"{take}, light {one.light} ({held}): relative RMSE {one.error['relative_rmse']:.1%}"


def _cropped_row(one: Comparison) -> NDArray[np.uint8]:
    picture, w = side_by_side(one), one.mask.shape[1]
    return np.concatenate([_crop(picture[:, i * w : (i + 1) * w], one.mask) for i in range(3)], axis=1)


def _recovered(results: Results) -> list[str]:
    header = [
        "take",
        "normal, median [deg]",
        "normal, 95 % [deg]",
        "R_d red [%]",
        "green",
        "blue",
        "held-out lights [%]",
        "fitted [%]",
    ]
    rows, sites = [], []
    for take, one in results.recovered.items():
        s: Any = one.summary()
        fit = results.fits[take]
        held = 100 * fit["held_out_error"]["median"] if "held_out_error" in fit else float("nan")
        rows.append(
            [
                take,
                s["normal_median_deg"],
                s["normal_95_deg"],
                *s["diffuse_median_percent"],
                held,
                100 * fit["status"].get("fitted", 0),
            ]
        )
        sites += [[take, site, *map(float, values)] for site, values in s["sigma_tr_percent"].items()]
    text = (
        "Median error over the fitted surfels against the true surface: angle of the normal, relative error of the "
        "diffuse reflectance per channel, relative error of samples under lights the fit did not see. On dark skin R_d "
        "comes out too high: measured BRDFs reflect some 0.02 evenly, which cannot be told from it."
    )
    note = (
        "sigma_tr of each probe site, relative error in per cent. The probe's photons walk at random and the fit is a "
        "solution of the transport equation, tabulated; what is left is noise and the finite fibres."
    )
    table = report.table(["take", "site", "red [%]", "green [%]", "blue [%]"], sites)
    return [
        report.paragraph(text),
        report.table(header, rows),
        report.plot(_scatter(results), "recovered against true"),
        report.paragraph(note),
        table,
    ]


def _scatter(results: Results) -> Any:
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4))
    for channel, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
        for one in results.recovered.values():
            pick = np.flatnonzero(one.fitted)[::40]
            true = one.true_diffuse[pick, channel]
            left.plot(true, true * (1 + one.diffuse_error[pick, channel]), ".", ms=2, color=colour, alpha=0.35)
    top = left.get_xlim()[1]
    left.plot([0, top], [0, top], "k-", lw=0.7)
    left.set_xlabel("true R_d [1]")
    left.set_ylabel("recovered R_d [1]")
    for take, one in results.recovered.items():
        angle = np.sort(one.normal_angle[one.fitted])
        angle = angle[np.isfinite(angle)]
        right.plot(angle, np.linspace(0, 100, len(angle)), label=take)
    right.set_xlim(0, 15)
    right.set_xlabel("angle between recovered and true normal [degree]")
    right.set_ylabel("surfels below [%]")
    right.legend(fontsize=7)
    return figure


def _translucency(results: Results) -> list[str]:
    study = results.studies["translucency"]
    ax = plot_translucency(study["translucency_table"].to_dataset().load())
    text = "sigma_tr in 1/mm by site and channel: mean over the subjects, their standard deviation, 95 % interval."
    return [report.paragraph(text), report.plot(ax.figure, "sigma_tr"), report.table(*tabulate_study(study))]


def _basis_size(results: Results) -> list[str]:
    curve = results.studies["brdf"]["basis_size"].to_dataset().load()
    near = f"{float(curve['plateau_tolerance']):.0%}"
    said = (
        f"Basis BRDFs that are enough: {curve.attrs['size_status']} (the plateau: within {near} of the largest size "
        f"tried, and that within {near} of all bases)."
    )
    ax = plot_basis_size(curve)
    return [
        report.paragraph(
            f"{said} The curve is measured on reflectance of {curve.attrs['surfels']} surfels of all takes together; "
            "the models above have 4 each, the paper's size for one person."
        ),
        report.plot(ax.figure, "basis size"),
    ]


def _albedo(results: Results) -> list[str]:
    ax = plot_albedo(results.studies["albedo"]["albedo"].to_dataset().load())
    text = (
        "Share of the face's area per decorrelated colour, first axis (mostly brightness); all takes share the edges."
    )
    return [report.paragraph(text), report.plot(ax.figure, "albedo histograms")]


def _trait(results: Results) -> list[str]:
    if not results.edits:
        return []
    images = {amount: portrait(tree) for amount, tree in results.edits.items()}
    exposure = auto_exposure(next(iter(images.values())))
    figures = []
    for amount, image in images.items():
        attrs = results.edits[amount].attrs
        trait = next(iter(attrs["edit"]))
        caption = f"{results.edited_take} with {amount:g} {trait}; distance {attrs['edit_distance']:.2f}"
        figures.append(
            report.picture(_crop(tone_map(image, exposure=exposure), image.sum(axis=2) > 0), caption, width=SHOWN + 60)
        )
    text = (
        "The trait vector is the mean with the trait less the mean without, within subjects where there are any; "
        "amounts are shares of it. An edit's distance is that of its nearest take over the median distance between "
        "takes: above 1 it leaves the data these few subjects give, and shows the method, not skin. brdf_shift, "
        "colour_shift and "
        "log_sigma_tr_shift are the root mean squares of the parts of the vector (coefficients of the common basis, "
        "quantiles of colour, channels), and the noises those of their standard errors by bootstrap over subjects. "
        "With one take on a side a vector is a difference of two people, and has no error."
    )
    return [report.paragraph(text), report.row(figures), report.table(*tabulate_study(results.studies["traits"]))]


def _time(results: Results) -> list[str]:
    stages: dict[str, list[float]] = {}
    for fit in results.fits.values():
        for name, seconds in fit["seconds"].items():
            stages.setdefault(name, []).append(seconds)
    rows = [[name, seconds] for name, seconds in results.seconds.items() if name != "report"]
    inside = [[name, float(np.mean(values))] for name, values in stages.items()]
    return [
        report.paragraph("Takes are worked on side by side; their seconds are added:"),
        report.table(["stage of the demo", "seconds"], rows),
        report.paragraph("The fit of one take, mean over takes:"),
        report.table(["stage of a fit", "seconds"], inside),
    ]

"""Parameters of commands and of the functions that they call, as frozen records.

The options of the command line are generated from the fields: each has its default, its
help and its limits here, and nowhere else. The limits hold for every caller. This module
imports nothing heavy, because ``--help`` reads it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Self, Union, get_args, get_origin, get_type_hints

from skindb.errors import Fault, input_error, require_none
from skindb.limits import (
    MAX_CAMERAS,
    MAX_DEMO_TAKES,
    MAX_FRAME_SIDE_PX,
    MAX_FRAMES,
    MAX_LIGHTS,
    MAX_PHOTOGRAPHS,
    MAX_PLACEMENTS,
    MAX_RELIEF_POINTS,
    MAX_SEED,
    MAX_SPACING_MM,
    MAX_VIRTUAL_PIXELS,
)

# Mean and standard deviation, over people, of the fraction of light along the normal that
# the surface of skin reflects in total, by condition (benchmarks/surface_energy.py). Bare
# skin: the part of 13,109 spectra that is white and independent of pigment is 0.044 (0.029
# to 0.057 in nine of ten laboratories; Lu et al. 2025, International Skin Spectra Archive);
# cheeks have indices of 1.51 to 1.53 (Yoshida et al. 2013, J. Biomed. Opt. 18, 037002),
# of which a smooth surface reflects 0.041 to 0.044, and a rough one 0.029 to 0.043.
BARE_SKIN = (0.040, 0.010)
SURFACE_ENERGY = {
    "normal": BARE_SKIN,
    "hot": BARE_SKIN,
    "cold": BARE_SKIN,
    "tan": BARE_SKIN,
    # a film of water on skin reflects 0.024; it need not be closed
    "sweat": (0.032, 0.012),
    # a film of oil, index 1.45 to 1.47, reflects 0.034 to 0.037
    "lotion": (0.038, 0.012),
}
# powder, makeup, and conditions without a source
SURFACE_ENERGY_ELSEWHERE = (0.040, 0.015)
# RMS angle of the normals of a scan that does not state it
SCAN_ERROR_DEGREES = 3.0
MAX_WIDTH_MM = 100_000.0  # of a picture on the subject: a wall
VIRTUAL_SEED = 2005
VIRTUAL_EXPOSURES = 2  # of every view of the virtual dome
CONDITIONS = ("normal", "lotion", "powder", "sweat", "hot", "cold", "makeup", "tan")
# Standard error of a light relative to the target along each axis, chosen in advance
# for a careful calibration. In generated captures with errors of 0.6 mm of lights and
# of cameras, intensities have z-scores of 0.9 to 1.2 with it.
POSITION_ERROR_MM = 1.0
# its file may change, so that a study with a dictionary is always computed
DICTIONARY_HELP = (
    "Dictionary to use instead of the embedded one: a folder of MERL files, or an .npz "
    "file of tables."
)


@dataclass(frozen=True)
class Option:
    """Help and limits of a parameter."""

    help: str
    minimum: int | float | None = None
    maximum: int | float | None = None
    above_minimum: bool = False  # the minimum itself is out of range
    name: str = ""  # on the command line, if it is not the name of the field
    metavar: str | None = None
    show_default: bool = True


def option(default: Any, help: str, **limits: Any) -> Any:  # noqa: A002
    """A field of a record with this default; `limits` are those of `Option`."""
    return field(default=default, metadata={"option": Option(help, **limits)})


def seed_option(purpose: str, default: int = 0) -> Any:
    """Field of a record for the random seed."""
    return option(default, f"Random seed for {purpose}.", minimum=0, maximum=MAX_SEED)


def option_of(record: type, name: str) -> Option:
    """Help and limits of a field of a record."""
    limits: Option = record.__dataclass_fields__[name].metadata["option"]  # type: ignore[attr-defined]
    return limits


def words_of(hint: Any) -> tuple[str, ...]:
    """The words that a parameter of this type accepts."""
    if get_origin(hint) is Literal:
        return get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return tuple(word for part in get_args(hint) for word in words_of(part))
    return ()


def require_limits(parameters: Any) -> None:
    """Raise `InputError` with every field of a record that is out of its limits."""
    record = type(parameters)
    hints = get_type_hints(record)
    faults = []
    for spec in fields(record):
        value = getattr(parameters, spec.name)
        rule = broken_rule(option_of(record, spec.name), hints[spec.name], value)
        if rule:
            faults.append(Fault(spec.name, rule, repr(value), "give another value"))
    require_none(faults)


def broken_rule(limits: Option, hint: Any, value: Any) -> str:
    """The rule that a value of this type breaks; empty if there is none."""
    words = words_of(hint)
    low = limits.minimum
    high = limits.maximum
    if value in words or (isinstance(value, bool) and bool in get_args(hint)):
        return ""
    if words and low is None:
        if value is None and NoneType in get_args(hint):
            return ""
        return f"must be one of {', '.join(words)}"
    if low is None or value is None:
        return ""
    is_number = isinstance(value, Integral if hint is int else Real)
    if not words and (not is_number or isinstance(value, bool)):
        return "must be a whole number" if hint is int else "must be a number"
    number = value if is_number else math.nan
    inside = number > low if limits.above_minimum else number >= low
    if inside and (high is None or number <= high):
        return ""
    if words:
        return f"must be {', '.join(words)}, or a number from {_short(low)} to {_short(high)}"
    if high is None:
        return f"must be at least {_short(low)}"
    start = "(" if limits.above_minimum else "["
    return f"must lie in {start}{_short(low)}, {_short(high)}]"


def _short(number: float | None) -> str:
    """A number as a person writes it, such as 1e-9."""
    return re.sub(r"e([+-])0*", lambda sign: "e" + sign[1].strip("+"), f"{number:g}")


class Limited:
    """A record whose fields are within their limits; others raise `InputError`."""

    def __post_init__(self) -> None:
        """Check the limits."""
        require_limits(self)


@dataclass(frozen=True)
class FitParameters(Limited):
    """Parameters of a fit.

    Parameters
    ----------
    k
        Number of components of the reduced basis; fewer if fewer surfels are fitted.
    surface
        Surface model: a mixture of the BRDFs of a dictionary, or one GGX lobe.
    mode, rank
        Mode and rank of the fit by the dictionary, see `fit_surface`.
    eta
        Refractive index of skin.
    surface_energy, surface_energy_error
        Mean and standard deviation of the prior for the fraction of light that the
        surface reflects in total, see `skindb.fit.energy`; "condition"
        takes those of `SURFACE_ENERGY`, and with "unknown" nothing is subtracted from R_d.
    light_gains
        Whether samples are first divided by the gain of their light, see
        `estimate_light_gains`. Lights that are held out have gain 1. "auto" decides by
        trials, see `skindb.fit.choice.choose_corrections`.
    inter_reflection
        Whether light from other parts of the face after one diffuse bounce is
        subtracted, see `bounced_light`; the first pass is then repeated. "auto" as above.
    hold_out_lights, hold_out_cameras
        Fractions of lights and cameras that are held out of the fit, to measure the
        error of predictions.
    seed
        Random seed for the hold-out, for sampling and for the starts of the factorisation.

    Raises
    ------
    InputError
        With every parameter that is out of range.
    """

    k: int = option(4, "Number of basis BRDFs of a mixture.", minimum=1)
    surface: Literal["mixture", "ggx"] = option(
        "mixture", "Surface model: mixture of measured BRDFs, or one GGX lobe."
    )
    mode: Literal["perceptual", "linear"] = option(
        "perceptual", "Space of the least squares: cube-root space, or linear."
    )
    rank: int = option(
        16,
        "Rank of the reduced dictionary of a mixture, beside the GGX lobes (59 is exact).",
        minimum=1,
    )
    eta: float = option(1.3, "Refractive index of skin.", minimum=1.0, maximum=2.0)
    surface_energy: float | Literal["condition", "unknown"] = option(
        "condition",
        "Fraction of light that the surface reflects in total, a prior of the even "
        "part that photographs do not show; unknown: R_d keeps it.",
        minimum=0,
        maximum=0.5,
    )
    surface_energy_error: float | Literal["condition"] = option(
        "condition",
        "Standard deviation of this fraction between people.",
        minimum=0,
        maximum=0.5,
    )
    light_gains: bool | Literal["auto"] = option(
        "auto",
        "Estimate one gain per light and divide its samples by it, for lights of "
        "doubtful intensity.",
    )
    inter_reflection: bool | Literal["auto"] = option(
        "auto",
        "Subtract inter-reflection between parts of the face (one diffuse bounce).",
    )
    hold_out_lights: float = option(
        0.0, "Fraction of lights held out.", minimum=0, maximum=0.9
    )
    hold_out_cameras: float = option(
        0.0, "Fraction of cameras held out.", minimum=0, maximum=0.9
    )
    seed: int = seed_option("the hold-out and for sampling")

    def __post_init__(self) -> None:
        """Check the limits, and that mixtures alone have `k` and `rank`."""
        super().__post_init__()
        if self.surface == "mixture":
            return
        faults = [
            Fault(spec.name, "mixtures alone have it", self.surface, "omit it")
            for spec in fields(self)
            if spec.name in ("k", "rank") and getattr(self, spec.name) != spec.default
        ]
        require_none(faults)

    @classmethod
    def of(cls, attrs: Mapping[Any, Any]) -> Self:
        """The parameters in the attributes of a model or of a first pass."""
        stored = attrs.get("parameters", {})
        names = [spec.name for spec in fields(cls) if spec.name in stored]
        return cls(**{name: stored[name] for name in names})

    def as_dict(self) -> dict[str, Any]:
        """The parameters as a dictionary for attributes."""
        return asdict(self)


@dataclass(frozen=True)
class IngestParameters(Limited):
    """Parameters of an ingest.

    Parameters
    ----------
    spacing_mm
        Distance of neighbouring surfels: that of an even lattice of as many surfels on the
        scan, or the width of the squares of a picture from which the surface is estimated.
        Points of a scan that are closer to each other stay.
    photographs
        Number of merged photographs kept for comparisons.
    calibration
        What to do with a capture whose photographs contradict its calibration: refuse
        it, or record a warning.
    refine
        Whether cameras are first rotated so that their photographs show the face at the
        scan, see `skindb.ingest.refinement.refine_cameras`. "auto" decides by a trial,
        see `choose_refinement` there.
    """

    spacing_mm: float = option(
        1.5,
        "Distance between neighbouring surfels in mm: the mean over the scan, or "
        "without a scan that in the picture.",
        name="spacing",
        minimum=0.05,
        maximum=MAX_SPACING_MM,
    )
    photographs: int = option(
        4,
        "Number of photographs kept for comparisons.",
        minimum=0,
        maximum=MAX_PHOTOGRAPHS,
    )
    calibration: Literal["refuse", "note"] = option(
        "refuse",
        "Treatment of captures whose photographs contradict their calibration: "
        "refused, or recorded as notes.",
    )
    refine: bool | Literal["auto"] = option(
        "auto",
        "Correct the orientation of each camera so that its photographs match the scan.",
    )


@dataclass(frozen=True)
class PictureParameters(Limited):
    """What is known about pictures of one camera, each under one light.

    Parameters
    ----------
    lights
        Table of the lights (CSV or RTI .lp): a line for each picture with its file name
        and the direction to the light, x to the right of the picture, y up, z to the
        camera; or columns x_mm, y_mm, z_mm of positions. Of a light stage it is in the
        frame of the cameras, and names are those in the pictures.
    mirror_ball
        Folder of pictures of a mirror ball under the same lights, in the same order, and
        one picture `*mask*` of its disc; instead of `lights`.
    mask
        Picture that is bright on the subject.
    response
        "srgb" or "linear" values, or a file with the response of the camera (CSV
        dn,r,g,b, see docs/capture_format.md); "auto" takes pictures of 8 bits as sRGB.
    width_mm
        Width of the picture on the subject.
    """

    lights: Path | None = option(
        None,
        "Table of the lights (.csv or RTI .lp): picture, x, y, z of the direction to "
        "the light; x to the right, y up, z to the camera. Columns x_mm, y_mm, z_mm "
        "are positions.  [default: lights.csv or the .lp file in SOURCE]",
    )
    mirror_ball: Path | None = option(
        None,
        "Folder of pictures of a mirror ball under the same lights, and of its mask.",
    )
    mask: Path | None = option(
        None,
        "Picture that is bright on the subject.  [default: *mask* in SOURCE]",
    )
    response: str = option(
        "auto",
        "Values of the pictures: srgb, linear, or a file with the response of the "
        "camera (dn,r,g,b); auto: 8 bits are sRGB, others are linear.",
        metavar="[auto|srgb|linear|FILE]",
    )
    width_mm: float | None = option(
        None,
        "Width of a picture on the subject in mm.  [default: 250 on the longer side, or "
        "6 a pixel if that is less]",
        name="width",
        minimum=0,
        maximum=MAX_WIDTH_MM,
        above_minimum=True,
    )


@dataclass(frozen=True)
class QuickParameters(PictureParameters):
    """What is known about pictures of one camera, and about the subject.

    Parameters
    ----------
    eta
        Refractive index of the subject.
    points
        Largest number of points of the maps and the page.
    """

    points: int = option(
        60_000,
        "Largest number of points of the maps and the page; with more, the fit takes "
        "longer, and browsers turn the page slowly.",
        minimum=1_000,
        maximum=MAX_RELIEF_POINTS,
    )
    eta: float = option(
        1.3,
        "Refractive index of the subject: 1.3 of skin; 1 of matt things without a smooth "
        "boundary, such as plaster or paper.",
        minimum=1.0,
        maximum=2.0,
    )


@dataclass(frozen=True)
class ImportParameters(PictureParameters):
    """What is known about pictures of one camera, or of a light stage.

    Parameters
    ----------
    cameras
        JSON with a list of `id, K, R, t` and optional `width, height, distortion`, as in
        dome.json, or a folder with cameras.txt and images.txt of COLMAP, whose images
        are named after the cameras.
    scan
        Scan in mm, PLY or OBJ. One camera needs none.
    """

    cameras: Path | None = option(
        None,
        "Cameras of olat: a JSON file, or a folder with a text model of COLMAP.  "
        "[default: cameras.json or SOURCE]",
    )
    scan: Path | None = option(
        None, "Triangle mesh of olat in mm.  [default: that in SOURCE]"
    )


def require_sizes(lights: int, cameras: int, width: int, height: int) -> None:
    """Require sizes within the limits of captures, before memory is allocated for them.

    Raises
    ------
    InputError
        With the first size beyond its limit.
    """
    views = MAX_FRAMES // VIRTUAL_EXPOSURES
    for what, size, most in (
        ("lights", lights, MAX_LIGHTS),
        ("cameras", cameras, MAX_CAMERAS),
        ("lights x cameras", lights * cameras, views),
        ("width x height", width * height, MAX_VIRTUAL_PIXELS),
    ):
        if not 1 <= size <= most:
            raise input_error(
                "virtual dome",
                f"{what} must be 1 to {most:,}",
                f"{size:,}",
                "choose another number",
            )


@dataclass(frozen=True)
class SimulationParameters(Limited):
    """Parameters of virtual captures: the dome, its frames in pixels, and the skin.

    Parameters
    ----------
    cameras, lights, width, height
        The dome and its frames in pixels.
    subsurface
        Transport diffuse light through the skin by the dipole instead of reflecting it
        where it enters.
    polarised
        Circular polarisers before the lights and cameras, see
        `skindb.virtual.dome.build_dome`.
    bases
        Number of BRDFs of which each patch of skin reflects one alone, instead of
        mixtures: at most four in a take, of which two differ in conditions other than normal.
    seed
        Random seed of the noise; shapes and skins depend on the people alone.
    """

    cameras: int = option(
        8, "Number of cameras of the virtual dome.", minimum=1, maximum=MAX_CAMERAS
    )
    lights: int = option(
        48, "Number of lights of the virtual dome.", minimum=1, maximum=MAX_LIGHTS
    )
    width: int = option(
        160, "Width of a frame in pixels.", minimum=16, maximum=MAX_FRAME_SIDE_PX
    )
    height: int = option(
        200, "Height of a frame in pixels.", minimum=16, maximum=MAX_FRAME_SIDE_PX
    )
    subsurface: bool = option(False, "Simulate subsurface transport by the dipole.")
    polarised: bool = option(
        False,
        "Circular polarisers, crossed in every other camera and parallel in the rest.",
    )
    bases: int | None = option(
        None,
        "Number of BRDFs of which each patch of skin reflects one alone.  "
        "[default: mixtures]",
        minimum=1,
        maximum=8,
    )
    seed: int = seed_option("noise", VIRTUAL_SEED)

    def __post_init__(self) -> None:
        """Check the limits of each size and of their products."""
        super().__post_init__()
        require_sizes(self.lights, self.cameras, self.width, self.height)


@dataclass(frozen=True)
class SessionParameters(Limited):
    """Parameters of a capture session in a real or a virtual laboratory.

    A real session needs `setup`, `dome`, `cameras`, `subject`, `consent`, `reference` and
    `scan`. A rehearsal (`virtual`) needs none of them: its subject is simulated, or taken
    from the capture that `setup` names.
    """

    setup: Path | None = option(
        None,
        "Folder with dome/dome.json and contact/probe.json of the laboratory; with "
        "--virtual, a complete capture, or a calibrated folder of the virtual dome.",
    )
    dome: str | None = option(
        None, "Address of the light controller: /dev/ttyACM0 or socket://host:port."
    )
    probe: str | None = option(None, "Address of the probe.")
    cameras: Path | None = option(
        None,
        "Folder that holds a folder of frames for each camera, and one named probe.",
    )
    subject: str | None = option(None, "Pseudonym of the subject.")
    condition: str = option("normal", "Condition of the skin.")
    traits: tuple[str, ...] = option(
        (),
        "Attribute (may be given several times).",
        name="trait",
        metavar="NAME=VALUE",
    )
    consent: str | None = option(
        None,
        "Scopes that the subject consents to, separated by commas: fit, statistics, "
        "export, publish.",
    )
    reference: str | None = option(None, "Reference to the signed consent form.")
    scan: Path | None = option(None, "Triangle mesh of the face in mm.")
    landmarks: Path | None = option(None, "Landmarks on the scan (.json).")
    regions: Path | None = option(None, "Regions of the scan (.json).")
    calibrated_by: str | None = option(
        None, "Name of the calibration of the dome that ingest takes from the database."
    )
    calibration: (
        Literal["board", "white", "ball", "dark", "flat", "chart", "response"] | None
    ) = option(
        None,
        "Record this calibration target into OUT, the folder of the laboratory, in place "
        "of a subject.",
    )
    sites: str = option(
        "",
        "Sites that the probe measures, separated by commas.  [default: none]",
        show_default=False,
    )
    placements: int | None = option(
        None,
        "Placements of the probe on each site, poses of the board or places of the ball.  "
        "[default: 1, 12, 3]",
        minimum=1,
        maximum=MAX_PLACEMENTS,
    )
    seconds: float | None = option(
        None,
        "Duration of the light sequence in seconds, without dark frames.  [default: the shortest]",
        minimum=0,
        maximum=3600,
        above_minimum=True,
    )
    slower: bool = option(False, "Flash at most three times in a second.")
    confirm_screening: bool = option(
        False,
        "Confirm that the subject was screened, consented, and keeps the eyes closed.",
    )
    operator: str | None = option(
        None, "ID of the operator who confirms the screening."
    )
    log: Path | None = option(
        None, "Folder for logs of all bytes exchanged with the devices."
    )
    virtual: bool = option(
        False, "Rehearse with emulated devices and a virtual subject."
    )
    seed: int | None = option(
        None,
        f"Random seed for the virtual subject.  [default: {VIRTUAL_SEED}]",
        minimum=0,
        maximum=MAX_SEED,
    )
    faults: tuple[str, ...] = option(
        (), "Fault of an emulated device.", name="fault", metavar="NAME=VALUE"
    )


@dataclass(frozen=True)
class CalibrationParameters(Limited):
    """Parameters of a calibration of the lights, cameras and probe of a laboratory."""

    name: str = option(MISSING, "Name by which captures refer to the calibration.")
    position_error: float = option(
        POSITION_ERROR_MM,
        "Standard error of the positions of the lights relative to the white target "
        "along each axis, in mm.",
        minimum=0,
        maximum=100,
    )


@dataclass(frozen=True)
class RenderParameters(Limited):
    """Parameters of a picture of a model, see `skindb.render.render_picture`."""

    lights: tuple[str, ...] = option(
        (),
        "Name of a light of the dome; several are added.  [default: all, or none with "
        "an environment]",
        name="light",
    )
    environment: Path | None = option(
        None, "Latitude-longitude image of light from all directions (.exr)."
    )
    camera: str | None = option(
        None, "Name of a camera of the dome.  [default: the most frontal one]"
    )
    view: Literal["dome", "front", "three-quarter", "left", "right"] = option(
        "dome",
        "View: that of a camera of the dome, or of the whole face; left is the subject's left.",
    )
    light_from: str | None = option(
        None,
        "Light at an azimuth, from the front to the subject's left, and an elevation in "
        "degrees.",
        metavar="AZ,EL",
    )
    samples: int = option(
        1024, "Largest number of rays per pixel.", name="spp", minimum=8, maximum=4096
    )
    error: float = option(
        0.05,
        "Relative standard error of radiance at which sampling stops; 0.05 is 2 % of "
        "displayed values.",
        minimum=1e-4,
        maximum=1,
    )
    seed: int = seed_option("the directions of rays")
    size: int | None = option(
        None,
        "Width of the picture in pixels.  [default: that of the camera; 480 with a view]",
        minimum=8,
        maximum=8192,
    )
    alpha: bool = option(False, "Make the background of a PNG transparent.")
    exposure: float | Literal["fixed", "auto"] = option(
        "fixed",
        "Exposure of a PNG: fixed (a white matt surface appears white), auto (for each "
        "picture), or a factor.",
        minimum=1e-9,
        maximum=1e9,
    )
    subsurface: bool = option(False, "Simulate subsurface transport by the dipole.")
    bounces: int = option(
        0,
        "Diffuse bounces of light between parts of the face; 1 if the fit subtracted it.",
        minimum=0,
        maximum=1,
    )


@dataclass(frozen=True)
class ComparisonParameters(Limited):
    """Parameters of a comparison of photographs with renderings of the model."""

    samples: int = option(2, "Number of rays per pixel and axis.", minimum=1, maximum=8)
    subsurface: bool = option(False, "Simulate subsurface transport by the dipole.")


@dataclass(frozen=True)
class ExportParameters(Limited):
    """Parameters of an export of a model."""

    size: int | None = option(
        None,
        "Number of texels along each side of a map.  [default: 1.5 per surfel spacing, "
        "rounded up to a power of two]",
        minimum=16,
        maximum=8192,
    )
    gltf: bool = option(
        False, "Write only glTF; for one take, --out may then be a .glb file."
    )
    merl: bool = option(True, "Skip the MERL binaries (35 MB each).", name="no-merl")


@dataclass(frozen=True)
class EditParameters(Limited):
    """Parameters of an edit of a model along traits."""

    traits: tuple[str, ...] = option(
        MISSING,
        "Trait and its amount, for example lotion=0.5 (may be given several times).",
        name="trait",
        metavar="NAME=AMOUNT",
    )
    study: str | None = option(
        None, "Study of traits.  [default: traits, or the only one]"
    )
    dictionary: Path | None = option(None, DICTIONARY_HELP)


@dataclass(frozen=True)
class ViewParameters(Limited):
    """Parameters of the page that shows models."""

    traits: tuple[str, ...] = option(
        (),
        "Trait that gets a slider, and the amount at its end, for example age=20; 1 if "
        "no amount is given (may be given several times).",
        name="trait",
        metavar="NAME[=AMOUNT]",
    )
    study: str | None = option(
        None, "Study of traits.  [default: traits, or the only one there is]"
    )
    modes: int = option(
        0,
        "Number of modes of the study of components that get a slider, which moves "
        "shape, albedo, gloss and translucency.",
        minimum=0,
        maximum=20,
    )
    environment: Path | None = option(
        None,
        "Environment: latitude-longitude image of light from all directions (.exr).  "
        "[default: overcast sky]",
    )
    dictionary: Path | None = option(None, DICTIONARY_HELP)


@dataclass(frozen=True)
class DemoParameters(Limited):
    """Parameters of the demo: its virtual dome and the number of its takes."""

    takes: int = option(
        MAX_DEMO_TAKES, "Number of virtual takes.", minimum=1, maximum=MAX_DEMO_TAKES
    )
    cameras: int = option(
        8, "Number of cameras of the virtual dome.", minimum=2, maximum=MAX_CAMERAS
    )
    lights: int = option(
        48, "Number of lights of the virtual dome.", minimum=12, maximum=MAX_LIGHTS
    )
    seed: int = seed_option("noise and sampling", VIRTUAL_SEED)
    workers: int | None = option(
        None,
        "Number of takes at a time.  [default: one for each core, at most 4]",
        minimum=1,
        maximum=MAX_DEMO_TAKES,
    )

"""Commands for the laboratory: capture, calibrate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.options import DB, PATH, Finite, Seed, common
from skindb.cli.shared import bar, emit
from skindb.cli.terminal import wait_for_enter


@click.command()
@click.argument("out", type=PATH)
@click.option(
    "--setup",
    type=PATH,
    help=(
        "Folder with dome/dome.json and contact/probe.json of the laboratory; with "
        "--virtual, a complete capture."
    ),
)
@click.option(
    "--dome",
    help="Address of the light controller: /dev/ttyACM0 or socket://host:port.",
)
@click.option("--probe", help="Address of the probe.")
@click.option(
    "--cameras",
    type=PATH,
    help="Folder that holds a folder of frames for each camera, and one named probe.",
)
@click.option("--subject", help="Pseudonym of the subject.")
@click.option("--condition", default="normal", help="Condition of the skin.")
@click.option(
    "--trait",
    "traits",
    multiple=True,
    metavar="NAME=VALUE",
    help="Attribute (may be given several times).",
)
@click.option(
    "--consent",
    help=(
        "Scopes that the subject consents to, separated by commas: fit, statistics, "
        "export, publish."
    ),
)
@click.option("--reference", help="Reference to the signed consent form.")
@click.option("--scan", type=PATH, help="Triangle mesh of the face in mm.")
@click.option("--landmarks", type=PATH, help="Landmarks on the scan (.json).")
@click.option("--regions", type=PATH, help="Regions of the scan (.json).")
@click.option(
    "--calibration",
    help="Name of the calibration of the dome that ingest takes from the database.",
)
@click.option(
    "--sites",
    default="",
    show_default=False,
    help="Sites that the probe measures, separated by commas.  [default: none]",
)
@click.option(
    "--placements",
    type=click.IntRange(1, 64),
    default=1,
    help="Placements of the probe on each site.",
)
@click.option(
    "--seconds",
    type=Finite(0, 3600, min_open=True),
    help="Duration of the light sequence in seconds, without dark frames.  [default: the shortest]",
)
@click.option("--slower", is_flag=True, help="Flash at most three times in a second.")
@click.option(
    "--base-light",
    "base",
    type=click.IntRange(0, 1000),
    default=0,
    help=(
        "Intensity of a steady lamp, in units of one light; it is measured before the "
        "lights flash."
    ),
)
@click.option(
    "--confirm-screening",
    is_flag=True,
    help="Confirm that the subject was screened, consented, and keeps the eyes closed.",
)
@click.option("--operator", help="ID of the operator who confirms the screening.")
@click.option(
    "--log", type=PATH, help="Folder for logs of all bytes exchanged with the devices."
)
@click.option(
    "--plan",
    "only_plan",
    is_flag=True,
    help="Show the sequence and its flash rate without driving any device.",
)
@click.option(
    "--yes",
    is_flag=True,
    help="Start each placement of the probe without waiting for Enter.",
)
@click.option(
    "--virtual",
    is_flag=True,
    help="Rehearse with emulated devices and a virtual subject.",
)
@click.option(
    "--seed", type=Seed(), help="Random seed for the virtual subject.  [default: 2005]"
)
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="NAME=VALUE",
    help="Fault of an emulated device.",
)
@common
def capture(out: Path, **options: Any) -> None:
    """Control a dome and a probe, and write a capture folder.

    Before it runs, the sequence is checked against the limits for photosensitive
    seizures. Triggers and frames are counted, and missing frames are repeated while the
    subject is present. The same command continues a capture that ended early.

    With --virtual, emulated devices and a virtual subject replace the laboratory; the
    files of the virtual subject are kept in OUT.virtual, which may be deleted. With
    --virtual and --setup, the emulated cameras deliver the frames of the capture that
    --setup names, for example one of your own dome.
    """
    ask = None if options["virtual"] or options.pop("yes") else _ask
    if options.pop("only_plan"):
        plan, lines = skindb.workflow.plan_session(out, options, progress=bar())
        emit(plan, lines)
        return
    found = skindb.workflow.capture_session(out, options, ask=ask, progress=bar())
    count = found["flashes_per_second"]
    rate = f"at most {count} {'flash' if count == 1 else 'flashes'} in any second"
    before = (
        ""
        if found["frames_of_this_session"]
        else " (all of them from earlier sessions)"
    )
    emit(
        found,
        [
            f"{out}: {found['frames']} frames{before} in {found['seconds']:.1f} s, {rate}",
            *found["notes"],
        ],
    )


def _ask(site: str, number: int) -> None:
    try:
        wait_for_enter(f"Place the probe on {site} ({number}), then press Enter")
    except click.Abort:
        # the session keeps and reports what it has recorded
        raise KeyboardInterrupt from None


@click.command()
@DB
@click.argument("setup", type=PATH)
@click.option(
    "--name", required=True, help="Name by which captures refer to the calibration."
)
@click.option(
    "--fit-falloff", is_flag=True, help="Also fit the angular fall-off of every light."
)
@click.option(
    "--position-error",
    type=click.FloatRange(0, 100),
    default=1.0,
    show_default=True,
    help=(
        "Standard error of the positions of the lights relative to the white target "
        "along each axis, in mm."
    ),
)
@common
def calibrate(
    db: str, setup: Path, name: str, fit_falloff: bool, position_error: float
) -> None:
    """Calibrate the lights, cameras and probe of a laboratory.

    Lights are calibrated from the frames of the white target in SETUP. If SETUP holds
    dome/calibration.json, the positions of the lights (by a mirror ball) and the
    cameras (response, noise, vignette, colour and lens) are calibrated first, where the
    frames for them exist. If it holds contact/calibration.json, the fibres of the probe
    are located and their gains measured.

    The result is a dated version in the database. Captures that name it (format version
    2, key `calibration`) use its newest version when they are ingested. Earlier
    versions are kept.
    """
    database = skindb.open(db)
    record = skindb.workflow.calibrate(
        database,
        setup,
        name=name,
        fit_falloff=fit_falloff,
        position_error=position_error,
    )
    about = skindb.workflow.describe_calibration(database, record)
    lines = [
        f"{name}: calibration {record.generation} of {about['lights']} lights, {record.path}"
    ]
    lines += [f"  {line}" for line in _camera_lines(about.get("cameras", {}))]
    if "largest_position_error_mm" in about:
        lines.append(
            "  positions of the lights: standard error at most "
            f"{about['largest_position_error_mm']:.2f} mm"
        )
    lines.append(
        f"  intensities are known to {about['total_relative_error']:.2%} or better: noise at most "
        f"{about['largest_relative_error']:.2%}, positions "
        f"{about['position_error']:.2%} and light beside the target "
        f"{about['glare']:.2%} (medians)"
    )
    if "probe" in about:
        gains = about["probe"]["largest_relative_error"]
        lines.append(
            f"  gains of {about['probe']['fibres']} fibres: known to {gains:.2%} or better"
        )
    if "largest_change" in about:
        lines.append(
            f"  largest change since {record.generation - 1}: "
            f"{about['largest_change']:.2%}, {about['most_changed']}"
        )
    if about["ingest_again"]:
        earlier = ", ".join(about["ingest_again"])
        lines.append(
            f"  captures that used an earlier calibration and should be ingested again: {earlier}"
        )
    emit(
        {"calibration": name, "generation": record.generation, "path": record.path}
        | about,
        lines,
    )


def _camera_lines(found: dict[str, Any]) -> list[str]:
    """Results of the calibration of the cameras, one line each."""
    words = {
        "dark frames": "at most {defect_pixels:.0f} hot or noisy pixels",
        "response": "photographed",
        "noise": "chi-squared at most {noise_chi_square:.2f} (1 if the sensor follows the model)",
        "vignette": "at most {vignette_residual:.2%} of the flat frames left",
        "colour": "CIEDE2000 of the chart at most {chart_difference:.2f} (median of its patches)",
        "edge": "blur at most {edge_blur:.2f} px",
        "known points": "rms distance from their projections at most {reprojection_rms:.2f} px",
    }
    return [
        f"{name} of {one['cameras']} cameras: {words[name].format(**one)}"
        for name, one in found.items()
    ]

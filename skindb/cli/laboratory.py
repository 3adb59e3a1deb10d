"""Commands for the laboratory: capture, check-device, calibrate, landmarks."""

from pathlib import Path

import click

import skindb
from skindb import workflow
from skindb.cli.options import DB, PATH, PORT, command, options_of
from skindb.cli.shared import aligned, emit, indented, serve, writable
from skindb.cli.terminal import bar, wait_for_enter
from skindb.errors import counted
from skindb.files import Json
from skindb.parameters import CalibrationParameters, SessionParameters


@command
@click.argument("out", type=PATH)
@options_of(SessionParameters)
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
def capture(
    out: Path, parameters: SessionParameters, only_plan: bool, yes: bool
) -> None:
    """Control a dome and a probe, and write a capture folder.

    Before it runs, the sequence is checked against the limits for photosensitive
    seizures. Triggers and frames are counted, and missing frames are repeated while the
    subject is present. The same command continues a capture that ended early.

    With --calibration, a calibration target is recorded in place of a subject, into OUT,
    which is the folder that skindb calibrate reads.

    With --virtual, emulated devices and a virtual subject replace the laboratory; the
    files of the virtual subject are kept in OUT.virtual, which may be deleted. With
    --virtual and --setup, the emulated cameras deliver the frames of the capture that
    --setup names, for example one of your own dome.
    """
    ask = None if parameters.virtual or yes else _ask
    if only_plan and parameters.calibration:
        raise click.UsageError("--plan belongs to the capture of a subject")
    if only_plan:
        plan, lines = workflow.plan_session(out, parameters, progress=bar())
        emit(plan, lines)
        return
    if parameters.calibration:
        recorded = workflow.record_target(out, parameters, ask=ask, progress=bar())
        emit(recorded, _recording_lines(recorded))
        return
    report = workflow.capture_session(out, parameters, ask=ask, progress=bar())
    count = report["flashes_per_second"]
    rate = f"at most {count} {'flash' if count == 1 else 'flashes'} in any second"
    before = (
        ""
        if report["frames_of_this_session"]
        else " (all of them from earlier sessions)"
    )
    emit(
        report,
        [
            f"{out}: {counted(report['frames'], 'frame')}{before} in "
            f"{report['seconds']:.1f} s, {rate}",
            *report["notes"],
        ],
    )


def _recording_lines(report: Json) -> list[str]:
    """What a recording of a calibration target has, one line each."""
    places = report["places"]
    at = f" at {places} places" if places > 1 else ""
    lines = [
        f"{report['path']}: {counted(report['frames'], 'frame')} of {report['kind']}{at}"
    ]
    if rms := report.get("rms_px"):
        worst = max(rms, key=rms.get)
        lines.append(
            f"corners are {rms[worst]:.2f} px (rms) or less from projections ({worst})"
        )
    return [*lines, *report["notes"]]


def _ask(request: str) -> None:
    try:
        wait_for_enter(f"{request}, then press Enter")
    except click.Abort:
        # the session keeps and reports what it has recorded
        raise KeyboardInterrupt from None


@command
@click.argument("url", metavar="PORT")
def check_device(url: str) -> None:
    """Compare a light controller or a probe with docs/protocol.md.

    PORT is a serial port or socket://HOST:PORT. Every exchange of the page that needs no
    hands is tried, in half a minute: damaged and repeated lines, refusals, plans with some
    twenty flashes, reports, emergency stop and watchdog, or pressure and exposures. Nobody
    should be in the dome or at the probe.
    """
    kind, faults = workflow.check_device(url)
    emit({"kind": kind}, [] if faults else [f"{url}: a {kind} that agrees"], faults)


@command
@DB
@click.argument("sources", metavar="[SETUP|TAKE...]", nargs=-1)
@click.option(
    "--from-takes",
    is_flag=True,
    help="Errors of lights and cameras from fitted takes of a rig.  [default: all takes]",
)
@options_of(CalibrationParameters)
def calibrate(
    db: str,
    sources: tuple[str, ...],
    from_takes: bool,
    parameters: CalibrationParameters,
) -> None:
    """Calibrate the lights, cameras and probe of a laboratory.

    If SETUP holds dome/boards.json, the cameras and, by a mirror ball, the lights are
    located in the frame of the board, and SETUP/dome/dome.json is completed.

    Lights are calibrated from the frames of the white target in SETUP. If SETUP holds
    dome/calibration.json, the positions of the lights (by a mirror ball) and the
    cameras (response, noise, vignette, colour and lens) are calibrated first, where the
    frames for them exist. If it holds contact/calibration.json, the fibres of the probe
    are located and their gains measured.

    With --from-takes, no set-up is needed: the gains and directions of the lights, and
    the gloss of the skin, are what three or more fitted takes have in common. Captures
    with the same lights use them when they are ingested.

    The result is a dated version in the database. Captures that name it (format version
    2, key `calibration`) use its newest version when they are ingested. Earlier
    versions are kept.
    """
    if from_takes:
        database = skindb.open(db, create=False)
        default = CalibrationParameters(parameters.name)
        if parameters != default:
            raise click.UsageError(
                "--position-error belongs to a SETUP; it has no meaning with --from-takes"
            )
        record = workflow.calibrate_rig(
            database, sources, name=parameters.name, progress=bar()
        )
        report = workflow.describe_rig(database, record)
        lines = _rig_lines(report)
    else:
        if len(sources) != 1:
            raise click.UsageError("give one SETUP, or --from-takes")
        database = skindb.open(db, create=True)
        record = workflow.calibrate(database, sources[0], **vars(parameters))
        report = workflow.describe_calibration(database, record)
        lines = _calibration_lines(report)
    if report["ingest_again"]:
        earlier = ", ".join(report["ingest_again"])
        lines.append(
            f"captures without this calibration, which should be ingested again: {earlier}"
        )
    summary = {
        "calibration": record.take,
        "generation": record.generation,
        "path": record.path,
    }
    source = f" from {counted(len(report['takes']), 'take')}" if from_takes else ""
    title = (
        f"{record.take}: calibration {record.generation} of "
        f"{counted(report['lights'], 'light')}"
        f"{source}, {record.path}"
    )
    emit(summary | report, [title, *indented(lines)])


def _rig_lines(report: Json) -> list[str]:
    """What a calibration from takes found, one line each."""
    misfit = report["misfit"]
    lines = [
        f"spread of the lights in a held-out take: {report['spread']:.1%} "
        f"without and {report['spread_left']:.1%} with the gains of the others (medians)",
        f"gains are known to {report['largest_relative_error']:.2%} or better, relative "
        "to each other"
        if report["light_gains"]
        else "intensities are left as stated",
        "residuals of a held-out take with the gains of the others: "
        f"{misfit['gains']:.0%} of those without; with their directions, too: "
        f"{misfit['gains and offsets']:.0%}",
        f"directions are moved by {report['angle']:.1f} degrees (rms), known to "
        f"{report['largest_angle_error']:.1f} or better, relative to each other"
        if report["angle"]
        else "directions are left as stated",
    ]
    if report["camera_gains"]:
        lines.append(
            f"spread of the cameras in a held-out take: {report['camera_spread']:.1%} "
            f"without and {report['camera_spread_left']:.1%} with the gains of the others"
        )
    elif report["cameras"] > 1:
        lines.append("cameras are left as stated")
    if report["lobes"]:
        lines.append("captures with few samples may share the lobes of these takes")
    if few := report["without_gain"]:
        lines.append(f"gain 1, as fewer than three takes show them: {', '.join(few)}")
    return lines


def _calibration_lines(report: Json) -> list[str]:
    """What a calibration found, one line each."""
    lines = _camera_lines(report.get("cameras", {}))
    if boards := report.get("boards"):
        lines.append(
            "geometry of {cameras} cameras by the board, written to dome.json: focal lengths "
            "within {focal_error_px:.1f} px, directions {turn_error_degrees:.2f} degrees, "
            "places {position_error_mm:.1f} mm (standard errors)".format(**boards)
        )
    if "largest_position_error_mm" in report:
        lines.append(
            "positions of the lights: standard error at most "
            f"{report['largest_position_error_mm']:.2f} mm"
        )
    lines.append(
        f"intensities are known to {report['total_relative_error']:.2%} or better: noise at most "
        f"{report['largest_relative_error']:.2%}, positions "
        f"{report['position_error']:.2%} and light beside the target "
        f"{report['glare']:.2%} (medians)"
    )
    if "probe" in report:
        gains = report["probe"]["largest_relative_error"]
        lines.append(
            f"gains of {report['probe']['fibres']} fibres: known to {gains:.2%} or better"
        )
    return lines


def _camera_lines(calibrated: Json) -> list[str]:
    """Results of the calibration of the cameras, one line each."""
    words = {
        "dark frames": "at most {defect_pixels:.0f} hot or noisy pixels",
        "response": "photographed",
        "noise": "chi-squared at most {noise_chi_square:.2f} (1 if the sensor follows the model)",
        "vignette": "at most {vignette_residual:.2%} of the flat frames left",
        "colour": "CIEDE2000 of the chart at most {chart_difference:.2f} (median of its patches)",
        "known points": "rms distance from their projections at most {reprojection_rms:.2f} px",
    }
    return [
        f"{name} of {counted(figures['cameras'], 'camera')}: {words[name].format(**figures)}"
        for name, figures in calibrated.items()
    ]


@command
@click.argument("scan", type=PATH)
@click.option(
    "--out",
    type=PATH,
    default=Path("landmarks.json"),
    help="File for the landmarks (.json).",
)
@PORT
def landmarks(scan: Path, out: Path, port: int) -> None:
    """Set the 20 landmarks and a crop box on a scan in a browser.

    The scan is a .ply or .obj file. The printed address opens the page, once, in one
    browser of this machine; Ctrl-C ends it. If the file exists, its landmarks are
    loaded. The crop box is written beside it, to a file that ends in .crop.json, by
    which skindb ingest crops the scan.
    """
    writable(out, ".json")
    serve(workflow.landmark_page(scan, out, port=port), out=str(out))


@command
@click.argument("scan", type=PATH)
@click.option(
    "--landmarks", type=PATH, required=True, help="Landmarks of the scan (.json)."
)
@click.option(
    "--seen",
    type=PATH,
    required=True,
    help='Pixels of landmarks in photographs (.json): {"c00": {"nose_tip": [812, 633], ...}, '
    "...}, three or more landmarks in two cameras each.",
)
@click.option(
    "--capture",
    "folder",
    type=PATH,
    required=True,
    help="Capture folder with the dome and the photographs.",
)
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="New folder for scan.ply, landmarks.json and pose.json.",
)
def register_scan(
    scan: Path, landmarks: Path, seen: Path, folder: Path, out: Path
) -> None:
    """Move SCAN from the frame of its scanner into that of the dome.

    The landmarks on the scan and in photographs give the position, which the comparison of
    the photographs with the scan improves. The scan may be in mm, cm, inch or m.
    """
    report = workflow.register_scan(scan, landmarks, seen, folder, out, progress=bar())
    distances = report["landmarks_px"]
    farthest = max(distances, key=distances.get)
    lines = [
        f"{out}: the scan is in {report['unit']}; landmarks are {report['rms_px']:.1f} px "
        f"(rms) from where they are seen, at most {distances[farthest]:.1f} ({farthest})",
        "the photographs show too little of the face to improve the position"
        if report["shift_mm"] is None
        else f"the photographs moved it by {report['shift_mm']:.2f} mm and "
        f"{report['turn_degrees']:.2f} degrees in the last round",
    ]
    emit(report, lines)


@command
@click.argument("setup", type=PATH)
@click.option(
    "--out", type=PATH, required=True, help="New file with the cameras (.json)."
)
def calibrate_cameras(setup: Path, out: Path) -> None:
    """Calibrate the cameras of a dome from pictures of a ChArUco board.

    SETUP/dome/boards.json names the pictures and the board. The result is a dome.json in
    the frame of the board in its first pose; other keys of SETUP/dome/dome.json are kept.
    """
    writable(out, ".json")
    report = workflow.calibrate_cameras(setup, out)
    header = [
        "camera",
        "poses",
        "rms [px]",
        "f +- [px]",
        "turn +- [deg]",
        "place +- [mm]",
    ]
    keys = (
        "poses",
        "rms_px",
        "focal_error_px",
        "turn_error_degrees",
        "position_error_mm",
    )
    rows = [[name, *(one[key] for key in keys)] for name, one in report.items()]
    emit(report, [f"{out}:", *aligned([header, *rows])])

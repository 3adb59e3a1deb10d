import typing

from .administration import (
    Refreshed,
    Withdrawal,
    backup,
    backup_states,
    clean,
    create_release,
    erasure_report,
    erasure_report_file,
    plan_withdrawal,
    record_consent,
    restore,
    stale_results,
    superseded_calibrations,
    superseded_lines,
    withdraw,
    write_erasure_report,
)
from .audit import NotLoggedWarning, acting_as, logged_action
from .captures import (
    calibrate,
    describe_calibration,
    ingest_if_changed,
    ingest_take,
    next_visits,
)
from .cohorts import register_takes, registered_datasets, summarise
from .edits import basis_grid, edit, edit_grid
from .fit import (
    dictionary_at,
    fit_take,
    fit_with,
    parameters_of,
    plan_take,
    takes_to_fit,
    takes_without_consent,
)
from .geometry import calibrate_cameras, register_scan
from .paper import reproduce
from .pictures import (
    compare_take,
    explain_view,
    export_take,
    landmark_page,
    render_take,
    show_take,
    translucency_grid,
    view_server,
    view_takes,
)
from .quicklook import quick
from .recordings import record_target
from .rig import calibrate_rig, describe_rig
from .session import capture_session, check_device, plan_session
from .simulation import begin_simulation, simulate
from .studies import STUDY_FUNCTIONS, study, tidy_table
from .takes import (
    Outcome,
    computing_on,
    connected,
    faults_of,
    map_takes,
    results_of,
)
from .upkeep import refresh, repeat_requests

__all__ = [
    "STUDY_FUNCTIONS",
    "NotLoggedWarning",
    "Outcome",
    "Refreshed",
    "Withdrawal",
    "acting_as",
    "backup",
    "backup_states",
    "basis_grid",
    "begin_simulation",
    "calibrate",
    "calibrate_cameras",
    "calibrate_rig",
    "capture_session",
    "check_device",
    "clean",
    "compare_take",
    "computing_on",
    "connected",
    "create_release",
    "describe_calibration",
    "describe_rig",
    "dictionary_at",
    "edit",
    "edit_grid",
    "erasure_report",
    "erasure_report_file",
    "explain_view",
    "export_take",
    "faults_of",
    "fit_take",
    "fit_with",
    "ingest_if_changed",
    "ingest_take",
    "landmark_page",
    "logged_action",
    "map_takes",
    "next_visits",
    "parameters_of",
    "plan_session",
    "plan_take",
    "plan_withdrawal",
    "quick",
    "record_consent",
    "record_target",
    "refresh",
    "register_scan",
    "register_takes",
    "registered_datasets",
    "render_take",
    "repeat_requests",
    "reproduce",
    "restore",
    "results_of",
    "show_take",
    "simulate",
    "stale_results",
    "study",
    "summarise",
    "superseded_calibrations",
    "superseded_lines",
    "takes_to_fit",
    "takes_without_consent",
    "tidy_table",
    "translucency_grid",
    "view_server",
    "view_takes",
    "withdraw",
    "write_erasure_report",
]

def __getattr__(name: str) -> typing.Any: ...  # the function of one study

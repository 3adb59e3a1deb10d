import typing

from .administration import (
    Refreshed,
    backup,
    backup_states,
    clean,
    create_release,
    record_consent,
    restore,
    stale_results,
    superseded_calibrations,
    superseded_lines,
)
from .audit import NotLoggedWarning, acting_as, logged_action
from .calibration import calibrate, describe_calibration
from .cluster import computing_on, connected, dashboard_link
from .edits import basis_grid, edit, edit_grid
from .executor import Outcome
from .fit import (
    dictionary_at,
    fit_take,
    fit_with,
    parameters_of,
    plan_take,
    takes_to_fit,
    takes_without_consent,
)
from .ingest import captured_subjects, ingest_take
from .pictures import (
    compare_take,
    export_take,
    render_take,
    show_take,
    translucency_grid,
)
from .registration import register_takes, registered_datasets
from .session import capture_session, plan_session
from .simulation import begin_cohort, simulate, simulate_one
from .studies import STUDY_FUNCTIONS, study
from .summaries import summarise
from .takes import faults_of, map_takes, results_of
from .upkeep import refresh, repeat_requests
from .viewing import (
    explain_view,
    landmark_page,
    view_server,
    view_takes,
)
from .withdrawal import (
    Withdrawal,
    erasure_report,
    plan_withdrawal,
    withdraw,
    write_erasure_report,
)

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
    "begin_cohort",
    "calibrate",
    "capture_session",
    "captured_subjects",
    "clean",
    "compare_take",
    "computing_on",
    "connected",
    "create_release",
    "dashboard_link",
    "describe_calibration",
    "dictionary_at",
    "edit",
    "edit_grid",
    "erasure_report",
    "explain_view",
    "export_take",
    "faults_of",
    "fit_take",
    "fit_with",
    "ingest_take",
    "landmark_page",
    "logged_action",
    "map_takes",
    "parameters_of",
    "plan_session",
    "plan_take",
    "plan_withdrawal",
    "record_consent",
    "refresh",
    "register_takes",
    "registered_datasets",
    "render_take",
    "repeat_requests",
    "restore",
    "results_of",
    "show_take",
    "simulate",
    "simulate_one",
    "stale_results",
    "study",
    "summarise",
    "superseded_calibrations",
    "superseded_lines",
    "takes_to_fit",
    "takes_without_consent",
    "translucency_grid",
    "view_server",
    "view_takes",
    "withdraw",
    "write_erasure_report",
]

def __getattr__(name: str) -> typing.Any: ...  # the function of one study

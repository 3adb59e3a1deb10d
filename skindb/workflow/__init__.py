"""Work on the takes of a database: read versions, call the scientific packages, commit
what they return.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import lazy_loader

if TYPE_CHECKING:
    from skindb.workflow.administration import (
        backup,
        backup_states,
        clean,
        create_release,
        record_consent,
        restore,
        superseded_calibrations,
        superseded_lines,
    )
    from skindb.workflow.audit import NotLoggedWarning, acting_as, logged_action
    from skindb.workflow.calibration import calibrate, describe_calibration
    from skindb.workflow.cluster import computing_on, connected, dashboard_link
    from skindb.workflow.edits import basis_grid, edit, edit_grid
    from skindb.workflow.executor import Outcome
    from skindb.workflow.fit import (
        dictionary_at,
        fit_take,
        fit_with,
        parameters_of,
        plan_take,
        takes_to_fit,
        takes_without_consent,
    )
    from skindb.workflow.ingest import captured_subjects, ingest_take
    from skindb.workflow.pictures import (
        compare_take,
        export_take,
        render_take,
        show_take,
        translucency_grid,
    )
    from skindb.workflow.registration import register_takes, registered_datasets
    from skindb.workflow.session import capture_session, plan_session
    from skindb.workflow.simulation import begin_cohort, simulate, simulate_one
    from skindb.workflow.studies import STUDY_FUNCTIONS, study
    from skindb.workflow.summaries import summarise
    from skindb.workflow.takes import faults_of, map_takes, results_of
    from skindb.workflow.upkeep import (
        Refreshed,
        refresh,
        repeat_requests,
        stale_results,
    )
    from skindb.workflow.viewing import (
        explain_view,
        landmark_page,
        view_server,
        view_takes,
    )
    from skindb.workflow.withdrawal import (
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

# each step needs other large packages: a command imports what it uses
_attribute, _, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "administration": [
            "backup",
            "backup_states",
            "clean",
            "create_release",
            "record_consent",
            "restore",
            "superseded_calibrations",
            "superseded_lines",
        ],
        "audit": ["NotLoggedWarning", "acting_as", "logged_action"],
        "calibration": ["calibrate", "describe_calibration"],
        "cluster": ["computing_on", "connected", "dashboard_link"],
        "edits": ["basis_grid", "edit", "edit_grid"],
        "fit": [
            "dictionary_at",
            "fit_take",
            "fit_with",
            "parameters_of",
            "plan_take",
            "takes_to_fit",
            "takes_without_consent",
        ],
        "ingest": ["captured_subjects", "ingest_take"],
        "session": ["capture_session", "plan_session"],
        "simulation": ["begin_cohort", "simulate", "simulate_one"],
        "pictures": [
            "compare_take",
            "export_take",
            "render_take",
            "show_take",
            "translucency_grid",
        ],
        "viewing": ["explain_view", "landmark_page", "view_server", "view_takes"],
        "upkeep": ["Refreshed", "refresh", "repeat_requests", "stale_results"],
        "registration": ["register_takes", "registered_datasets"],
        "studies": ["STUDY_FUNCTIONS", "study"],
        "summaries": ["summarise"],
        "executor": ["Outcome"],
        "takes": ["faults_of", "map_takes", "results_of"],
        "withdrawal": [
            "Withdrawal",
            "erasure_report",
            "plan_withdrawal",
            "withdraw",
            "write_erasure_report",
        ],
    },
)


def __getattr__(name: str) -> Any:
    """A step, or the function of one study: `translucency` is `study` with this name."""
    try:
        return _attribute(name)
    except AttributeError:
        if name.startswith("_") or name not in _attribute("STUDY_FUNCTIONS"):
            raise
        return _attribute("STUDY_FUNCTIONS")[name]


def __dir__() -> list[str]:
    """The steps, and the functions of the studies."""
    return sorted([*__all__, *_attribute("STUDY_FUNCTIONS")])

"""Checks of the consent of subjects, for every step that needs a scope of consent."""

from collections.abc import Mapping
from typing import Any

from skindb.errors import input_error

SCOPES = ("fit", "statistics", "export", "publish")
CONSENT = "consent"  # kind of the versions that record what a subject agreed to


def consent_scope(attrs: Mapping[Any, Any]) -> tuple[str, ...]:
    """The scopes that the attributes or the provenance of a version name."""
    return tuple(str(item) for item in attrs.get("consent_scope") or ())


def require_consent(attrs: Mapping[Any, Any], scope: str) -> None:
    """Raise `InputError` unless the consent in `attrs` names `scope`, one of `SCOPES`."""
    scopes = consent_scope(attrs)
    if scope in scopes:
        return
    who = str(attrs.get("take", attrs.get("subject", "the subject")))
    text = f"only {', '.join(scopes)}" if scopes else "no scope at all"
    raise input_error(
        f"{who}: consent_scope",
        f"this step needs the scope {scope!r}",
        text,
        "ask the subject, then record the answer with skindb consent",
    )


def honour_consent(attrs: Mapping[Any, Any], scope: str) -> None:
    """As `require_consent` for data that carry a consent; data without one belong to
    nobody or were checked before.
    """
    if "consent_scope" in attrs:
        require_consent(attrs, scope)

"""What a subject agreed to, asked before anything leaves the database."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.errors import Fault, InputError


def require_consent(attrs: Mapping[Any, Any], scope: str) -> None:
    """Raise `InputError` unless `attrs["consent_scope"]` names `scope` (fit, statistics, export, publish)."""
    given = [str(item) for item in attrs.get("consent_scope", [])]
    if scope not in given:
        who = str(attrs.get("subject", "the subject"))
        found = f"only {', '.join(given)}" if given else "no scope at all"
        cure = "ask the subject, then correct capture.json and ingest again"
        raise InputError(Fault(f"{who}: consent_scope", f"this step needs the scope {scope!r}", found, cure))

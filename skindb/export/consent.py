"""What a subject agreed to, asked before anything leaves the database."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.errors import Fault, InputError
from skindb.schema.plain import plain


def edited_from(attrs: Mapping[Any, Any]) -> dict[str, Any] | None:
    """Of an edited model: whose it is, what was added, and why the consent is that person's; None of any other."""
    if "edit" not in attrs:
        return None
    made_from = {str(one["kind"]): one.get("generation") for one in attrs.get("inputs", [])}
    whose = str(attrs.get("take", attrs.get("subject", "a subject")))
    about = {
        "from": whose,
        "model_generation": made_from.get("model"),
        "by": dict(attrs["edit"]),
        "traits_generation": made_from.get("population"),
        "distance": attrs.get("edit_distance"),
        "consent": f"this face was not measured: it is {whose} with traits of others added, made from the data of "
        f"{whose}, whose consent covers it; whoever shows it says that it was edited",
    }
    return dict(plain(about))


def require_consent(attrs: Mapping[Any, Any], scope: str) -> None:
    """Raise `InputError` unless `attrs["consent_scope"]` names `scope` (fit, statistics, export, publish)."""
    given = [str(item) for item in attrs.get("consent_scope", [])]
    if scope not in given:
        who = str(attrs.get("subject", "the subject"))
        found = f"only {', '.join(given)}" if given else "no scope at all"
        cure = "ask the subject, then correct capture.json and ingest again"
        raise InputError(Fault(f"{who}: consent_scope", f"this step needs the scope {scope!r}", found, cure))

"""What an export says of an edited model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.schema.plain import plain


def describe_edit(attrs: Mapping[Any, Any]) -> dict[str, Any] | None:
    """Whose model was edited, what was added, and whose consent covers it; None if the model was not edited."""
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

"""Description of an edited model in exports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.schema.plain import plain


def describe_edit(attrs: Mapping[Any, Any]) -> dict[str, Any] | None:
    """Origin of an edited model, the edit, and whose consent covers it; None if the
    model was not edited.
    """
    if "edit" not in attrs:
        return None
    made_from = {
        str(one["kind"]): one.get("generation") for one in attrs.get("inputs", [])
    }
    whose = str(attrs.get("take", attrs.get("subject", "a subject")))
    about = {
        "from": whose,
        "model_generation": made_from.get("model"),
        "by": dict(attrs["edit"]),
        "traits_generation": made_from.get("population"),
        "distance": attrs.get("edit_distance"),
        "consent": f"This face was not measured. It was computed from the data of {whose}, "
        "with traits of other "
        f"subjects added. The consent of {whose} covers it. Whoever shows it must "
        "state that it was edited.",
    }
    return dict(plain(about))

"""Who may be counted, and who has a trait."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError

Takes = Mapping[str, xr.DataTree]


def consenting(models: Takes) -> dict[str, xr.DataTree]:
    """The takes whose consent covers statistics; `InputError` if there is none."""
    allowed = {take: tree for take, tree in models.items() if "statistics" in tree.attrs.get("consent_scope", [])}
    if not allowed:
        found = "no take" if not models else f"{len(models)} takes, none with 'statistics' in its consent"
        raise InputError(Fault("population", "statistics need takes that consent to them", found, "see consent.scope"))
    return allowed


def left_out(models: Takes) -> list[str]:
    """One line for every take whose consent does not cover statistics."""
    refused = sorted(set(models) - set(consenting(models)))
    return [f"{take}: its consent does not cover statistics" for take in refused]


def trait_names(models: Takes) -> list[str]:
    """Every trait that some takes have and others lack: conditions, words of the traits, and `older`."""
    words = {str(tree.attrs.get("condition", "normal")) for tree in models.values()} - {"normal"}
    for tree in models.values():
        words |= {str(v) for v in tree.attrs.get("traits", {}).values() if isinstance(v, str)}
        words |= {str(k) for k, v in tree.attrs.get("traits", {}).items() if v is True}
    if any("age" in tree.attrs.get("traits", {}) for tree in models.values()):
        words.add("older")
    return sorted(word for word in words if 0 < has_trait(models, word).sum() < len(models))


def has_trait(models: Takes, trait: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which takes have a trait: their condition, a trait's word or a true flag; `older`: above the median age."""
    if trait == "older":
        ages = np.array([float(tree.attrs.get("traits", {}).get("age", np.nan)) for tree in models.values()])
        return np.asarray(ages > np.nanmedian(ages))
    return np.array([_carries(tree.attrs, trait) for tree in models.values()], np.bool_)


def _carries(attrs: Mapping[Any, Any], trait: str) -> bool:
    traits = attrs.get("traits", {})
    words = {str(value) for value in traits.values() if isinstance(value, str)}
    return attrs.get("condition", "normal") == trait or trait in words or traits.get(trait) is True


def comparable(models: Takes, trait: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Takes to compare for a trait.

    A condition is compared within the subjects that were measured with and without it where there are any: between
    subjects it would be mixed up with everything else that differs.
    """
    carries = has_trait(models, trait)
    subjects = np.array([str(tree.attrs.get("subject", take)) for take, tree in models.items()])
    conditions = np.array([str(tree.attrs.get("condition", "normal")) for tree in models.values()])
    if trait not in conditions:
        # a subject in three conditions is one subject, and the conditions would mix in
        plain = conditions == "normal"
        return np.asarray(plain if (carries & plain).any() else plain | carries)
    paired = {s for s in subjects[carries] if ((subjects == s) & (conditions == "normal")).any()}
    if not paired:
        return np.asarray(carries | (conditions == "normal"))
    return np.asarray(np.isin(subjects, list(paired)) & (carries | (conditions == "normal")))

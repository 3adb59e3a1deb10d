"""Who may be counted, and who has a trait."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError

Takes = Mapping[str, xr.DataTree]
Mask = NDArray[np.bool_]
OLDER = "older"
EVERYBODY, UNKNOWN = "all", "unknown"


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


def nothing_fitted(model: xr.DataTree) -> InputError:
    """What to say of a take that a population cannot count."""
    where = str(model.attrs.get("subject", "take"))
    return InputError(Fault(where, "a population needs fitted surfels", "none", "leave the take out or fit it again"))


def trait_names(models: Takes) -> list[str]:
    """Every trait with takes on both sides: conditions, words of the traits, flags, and `older`."""
    words = {str(tree.attrs.get("condition", "normal")) for tree in models.values()} - {"normal"}
    for tree in models.values():
        words |= {str(v) for v in tree.attrs.get("traits", {}).values() if isinstance(v, str)}
        words |= {str(k) for k, v in tree.attrs.get("traits", {}).items() if v is True}
    if np.isfinite(_ages(models)).any():
        words.add(OLDER)
    return sorted(word for word in words if all(side.any() for side in sides(models, word)))


def sides(models: Takes, trait: str) -> tuple[Mask, Mask]:
    """Takes with and takes without a trait, as far as they can be compared."""
    carries, usable = has_trait(models, trait), comparable(models, trait)
    return carries & usable, ~carries & usable


def has_trait(models: Takes, trait: str) -> Mask:
    """Which takes have a trait: their condition, a trait's word or a true flag; `older`: above the median age."""
    if trait == OLDER:
        ages = _ages(models)
        subjects = {_subject(take, tree): age for (take, tree), age in zip(models.items(), ages, strict=True)}
        known = [age for age in subjects.values() if np.isfinite(age)]
        return np.asarray(ages > (np.median(known) if known else np.inf))
    return np.array([_carries(tree.attrs, trait) for tree in models.values()], np.bool_)


def comparable(models: Takes, trait: str) -> Mask:
    """Takes to compare for a trait; those that say nothing about it are on neither side.

    A condition is compared within the subjects that were measured with and without it where there are any: between
    subjects it would be mixed up with everything else that differs.
    """
    carries = has_trait(models, trait)
    subjects = np.array([_subject(take, tree) for take, tree in models.items()])
    conditions = np.array([str(tree.attrs.get("condition", "normal")) for tree in models.values()])
    plain = conditions == "normal"
    if trait not in conditions:
        # a subject in three conditions is one subject, and the conditions would mix in
        return np.asarray(_knows(models, trait) & (plain if (carries & plain).any() else plain | carries))
    paired = {s for s in subjects[carries] if ((subjects == s) & plain).any()}
    if not paired:
        return np.asarray(carries | plain)
    return np.asarray(np.isin(subjects, list(paired)) & (carries | plain))


def people(models: Takes, group_by: str | None) -> dict[str, xr.DataTree]:
    """The takes that count: in the condition normal, or all where conditions are what is compared."""
    conditions = {take: str(tree.attrs.get("condition", "normal")) for take, tree in models.items()}
    compared = group_by == "condition" or (group_by != "normal" and group_by in conditions.values())
    return {take: tree for take, tree in models.items() if compared or conditions[take] == "normal"}


def nobody(models: Takes) -> InputError:
    """What to say where `people` leaves nobody."""
    rule, found = "groups need a take in the condition normal", f"only {', '.join(sorted(consenting(models)))}"
    return InputError(Fault("population", rule, found, "group by condition, or add the subjects' other takes"))


def groups_by(models: Takes, name: str | None) -> dict[str, str]:
    """Take -> its group by an attribute or a trait; None makes one group. `InputError` for what no take knows."""
    if name is None:
        return dict.fromkeys(models, EVERYBODY)
    found = {take: _attribute(tree.attrs, name) for take, tree in models.items()}
    if any(found.values()):
        return {take: group or UNKNOWN for take, group in found.items()}
    carries, known = has_trait(models, name), _knows(models, name)
    if not carries.any():
        attributes = {str(k) for tree in models.values() for k in tree.attrs.get("traits", {})} | {"condition"}
        there = f"attributes: {', '.join(sorted(attributes))}; traits: {', '.join(trait_names(models)) or 'none'}"
        raise InputError(
            Fault(f"group by {name}", "takes are grouped by what they have", "nothing by that name", there)
        )
    words = [(name if has else f"not {name}") if knows else UNKNOWN for has, knows in zip(carries, known, strict=True)]
    return dict(zip(models, words, strict=True))


def _attribute(attrs: Mapping[Any, Any], name: str) -> str:
    if name == "condition":
        return str(attrs.get(name, "normal"))
    value = attrs.get("traits", {}).get(name, attrs.get(name))
    return "" if value is None or isinstance(value, dict | list) else str(value)


def _subject(take: str, tree: xr.DataTree) -> str:
    return str(tree.attrs.get("subject", take))


def _ages(models: Takes) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    ages = [tree.attrs.get("traits", {}).get("age") for tree in models.values()]
    return np.array([float(a) if isinstance(a, int | float) and a is not True else np.nan for a in ages])


def _carries(attrs: Mapping[Any, Any], trait: str) -> bool:
    traits = attrs.get("traits", {})
    words = {str(value) for value in traits.values() if isinstance(value, str)}
    return attrs.get("condition", "normal") == trait or trait in words or traits.get(trait) is True


def _knows(models: Takes, trait: str) -> Mask:
    """Which takes say whether they have a trait: they have the attribute under which others have its word."""
    if trait == OLDER:
        return np.isfinite(_ages(models))
    said = [tree.attrs.get("traits", {}) for tree in models.values()]
    under = {k for traits in said for k, v in traits.items() if v == trait or (k == trait and isinstance(v, bool))}
    return np.array([not under or not under.isdisjoint(traits) for traits in said], np.bool_)

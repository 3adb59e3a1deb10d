"""Verify and read damaged databases, each in its own process, within limits of time and memory.

    python tests/destructive/fuzz_store.py --cases 1000 --seed 0

`verify` must name the damage, and nothing that is read may differ from what was
committed, or a line with a cure must say why it is refused. Tracebacks, hangs,
gigabytes of memory and messages of libraries are failures, and the program then ends
with 1.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock
from unittest.mock import patch

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

import apart
import dask
import numpy as np
import xarray as xr
from mutations_store import damage, kind_of
from planted_cohort import few_materials

import skindb
import skindb.analysis  # as the next: else every process would import it
import skindb.ingest
from skindb import workflow
from skindb.cli import main
from skindb.errors import Fault, InputError
from skindb.files import plain
from skindb.fit import FitParameters
from skindb.store.log import Log

HARMLESS = {
    "head": "harmless: a damaged head",
    "tombstone": "harmless: a tombstone",
    "tmp": "harmless: scratch",
    "leases": "harmless: a lease that nobody holds",
    # other damage of it is named
    "audit": "harmless: the end of the audit log was removed",
    # a cache: what is read must be the same without it
    "catalogue": "harmless: a damaged catalogue",
}
SAME = "harmless: the same JSON values"
UNCHANGED = "harmless: nothing was changed"
BAD = (
    "undetected change",
    "changed, but named by verify",
    "refused, but not named by verify",
    "message without cure",
)
OUTCOMES = (
    "named by verify",
    *HARMLESS.values(),
    SAME,
    UNCHANGED,
    *BAD,
    *apart.FAILURES,
)
COMMANDS = (
    ("verify",),
    ("info",),
    ("info", "-v"),
    ("fit", "--explain"),
    ("analyze", "translucency"),
)
# what was read -> digest of each part, or the message of the refusal
Numbers = dict[str, Any]


def database(root: Path) -> None:
    """Two virtual takes, the model of one, and three generations of a study, of which
    the second was removed.
    """
    size = {"cameras": 3, "lights": 12, "width": 48, "height": 60}
    db = skindb.open(str(root), create=True)
    for folder in workflow.simulate(root.parent / "captures", takes=2, **size):
        workflow.ingest_take(db, folder, spacing_mm=8.0, photographs=1)
    workflow.fit_take(
        db, "V001", FitParameters(k=2, rank=4), dictionary=few_materials()
    )
    # a study of the same model by the same code would be the same version
    for code in "123":
        with patch("skindb.workflow.derive.code_digest", lambda *_, code=code: code):
            workflow.translucency(db)
    Log(db.place, "population", "translucency").remove(2)
    if faults := db.verify():
        raise AssertionError(faults)


def read_all(
    root: Path, versions: list[list[Any]], damage: str = ""
) -> tuple[Numbers, list[Fault]]:
    """Digests of all that can be read, and the faults of what is refused.

    Values are loaded of the kinds that the description of the damage names, or of all
    if it names none; the others are opened.
    """
    near = {kind for kind, _, _ in versions if f"/{kind}" in damage} or {
        kind for kind, _, _ in versions
    }
    db = skindb.open(str(root), create=True)
    found = {}
    faults = []

    def add(name: str, call: Callable[[], Any]) -> None:
        try:
            found[name] = call()
        except InputError as error:
            found[name] = None
            faults.extend(error.faults or [Fault(name, "no fault", "")])

    add("takes", lambda: takes_of(db, {(kind, take) for kind, take, _ in versions}))
    add("info", lambda: without_faults(db.info(), root, faults))
    add("table", lambda: db.table().to_json(date_format="iso"))
    for kind, take, generation in versions:
        one = partial(db.read, kind, take, generation=generation)
        add(
            f"{kind} {generation} of {take}",
            lambda r=one, load=kind in near: digests(r(), load=load),
        )
    for kind, take in sorted({(kind, take) for kind, take, _ in versions}):
        add(
            f"newest {kind} of {take}",
            lambda k=kind, t=take: db.record(k, t).generation,
        )
        add(
            f"history of {kind} {take}",
            lambda k=kind, t=take: [r.generation for r in db.history(k, t)],
        )
    add("cohort", lambda: digests(xr.DataTree(db.cohort("tables"))))
    return json.loads(json.dumps(found)), faults


def takes_of(
    db: skindb.store.Database, known: set[tuple[str, str]]
) -> dict[str, list[str]]:
    """Kinds and takes, except for unknown ones that are listed because records were
    lost; reading those is refused.
    """
    out: dict[str, list[str]] = {}
    for kind in db.kinds():
        for take in db.takes(kind):
            with suppress(InputError):
                if (kind, take) in known or db.record(kind, take):
                    out.setdefault(kind, []).append(take)
    return out


def without_faults(info: dict[str, Any], root: Path, faults: list[Fault]) -> Any:
    """The result of `info`, in which each damaged record is refused separately."""
    said = {}
    for group, takes in info.items():
        for take, kinds in takes.items():
            for kind, one in kinds.items():
                # results that are out of date are refused, or read with a warning
                if "stale" in one:
                    faults.append(
                        Fault("info", "", one.pop("stale")[0], "skindb refresh")
                    )
                said[f"{group} {take} {kind}"] = (
                    None if "fault" in one else json.dumps(one).replace(str(root), "")
                )
                if "fault" in one:
                    faults.append(
                        Fault(
                            "info",
                            "",
                            one["fault"],
                            one["fault"].partition("; found ")[2].partition("; ")[2],
                        )
                    )
    return said


def digests(tree: xr.DataTree, *, load: bool = True) -> dict[str, str | None]:
    """Digest of the values of every variable, None if they are not loaded, and the attributes."""
    attrs = plain(tree.attrs)
    # no consent at all is what a version says whose consent cannot be read: a refusal
    out: dict[str, str | None] = {
        "consent": json.dumps(attrs.pop("consent_scope", [])).replace("[]", "") or None
    }
    out["attrs"] = json.dumps(attrs, sort_keys=True)
    for node in tree.subtree:
        ds = node.to_dataset()
        for name, variable in (ds.load() if load else ds).variables.items():
            out[f"{node.path}/{name}"] = digest(variable.values) if load else None
    return out


def digest(values: np.ndarray) -> str:
    """Digest of values, shape and type."""
    raw = (
        values.tobytes()
        if values.dtype.kind in "fiub"
        else json.dumps(plain(values)).encode()
    )
    return hashlib.sha256(raw + str((values.shape, values.dtype)).encode()).hexdigest()


def differences(found: Any, true: Any, name: str = "") -> list[str]:
    """Names of parts that were read and differ; refused parts do not count."""
    if found is None or found == true:
        return []
    if not (isinstance(found, dict) and isinstance(true, dict)):
        return [f"{name}: {str(found)[:80]}"]
    gone = [f"{name} {key} is gone" for key in true if key not in found]
    return gone + [
        line
        for key in found
        for line in differences(found[key], true.get(key), f"{name} {key}")
    ]


def call(*args: str) -> tuple[int, str, str]:
    """Exit, output and messages of a command."""
    out = io.StringIO()
    err = io.StringIO()
    code = 0
    with (
        mock.patch.object(sys, "argv", ["skindb", *args]),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return code, out.getvalue(), err.getvalue()


def command_faults(root: Path, number: int) -> list[Fault]:
    """Faults of a command with --json, which must print one JSON value, and a reason
    for each failure.
    """
    name, *options = COMMANDS[number % len(COMMANDS)]
    code, out, err = call(name, str(root), *options, "--json")
    told = json.loads(out)
    if code not in (0, 1) or (code and not told.get("error")) or "Traceback" in err:
        raise AssertionError(f"{name}: {code} {out} {err}")
    errors = told["error"] if code else []
    return [
        Fault(one["what"], one["rule"], one["found"], one["cure"]) for one in errors
    ]


def attempt(
    root: Path, true: Numbers, number: int, what: str, unchanged: str
) -> apart.Outcome:
    """Verify and read the database, and compare."""
    with dask.config.set(scheduler="synchronous"):
        named = skindb.open(str(root), create=True).verify()
        skindb.open(str(root), create=True).garbage()  # with any damage
        found, refused = read_all(root, true["versions"], what)
        told = command_faults(root, number // 4) if number % 4 == 0 else []
    changed = differences(found, true["numbers"])
    faults = [*named, *refused, *told]
    if bad := [
        str(fault) for fault in faults if not (fault.cure and str(fault).isprintable())
    ]:
        return "message without cure", bad[0]
    if changed:
        where = "; ".join(changed[:3])
        return (
            "changed, but named by verify" if named else "undetected change"
        ), f"{where} | {named[:1]}"
    if named:
        return "named by verify", str(named[0])
    if refused or told:
        return "refused, but not named by verify", str([*refused, *told][0])
    return unchanged, ""


def unchanged_reason(before: Path, after: Path, kind: str) -> str:
    """The reason why damage that is not reported is harmless."""
    files = [path for path in before.rglob("*") if path.is_file()]
    others = [
        path for path in files if not _same(path, after / path.relative_to(before))
    ]
    if not others:
        return UNCHANGED if kind != "foreign" else "undetected change"
    values = [
        path
        for path in others
        if not _same_json(path, after / path.relative_to(before))
    ]
    kinds = {kind_of(before, path) for path in values}
    if kinds <= HARMLESS.keys():
        return HARMLESS[kinds.pop()] if kinds else SAME
    return "undetected change"


def _same(one: Path, other: Path) -> bool:
    """Regular files of the same bytes; a sparse file of gigabytes is not read."""
    if (
        other.is_symlink()
        or not other.is_file()
        or one.stat().st_size != other.stat().st_size
    ):
        return False
    return one.read_bytes() == other.read_bytes()


def _same_json(one: Path, other: Path) -> bool:
    if other.is_symlink() or not other.is_file() or other.stat().st_size > 1_000_000:
        return False
    try:
        return json.loads(one.read_bytes()) == json.loads(other.read_bytes())
    except (ValueError, RecursionError):
        return False


def run(
    cases: range, seed: int, folder: Path, limits: apart.Limits
) -> list[apart.Case]:
    """Damage, read and judge every case."""
    whole = folder / "whole/db"
    kept = folder / "true.json"
    whole.parent.mkdir()
    apart.in_a_process(lambda: database(whole))
    logs = sorted(whole.glob("log/*/*/*.json"))
    versions = [[*path.parts[-3:-1], int(path.stem)] for path in logs]

    def keep() -> None:
        numbers, faults = read_all(whole, versions)
        assert not faults, faults
        kept.write_text(json.dumps({"versions": versions, "numbers": numbers}))

    apart.in_a_process(keep)
    true = json.loads(kept.read_text())

    def prepare(number: int, work: Path):
        root = Path(shutil.copytree(whole, work / "db"))
        kind, what = damage(root, np.random.default_rng([seed, number]))
        return (
            kind,
            what,
            partial(
                attempt, root, true, number, what, unchanged_reason(whole, root, kind)
            ),
        )

    return apart.run(cases, prepare, folder, limits)


if __name__ == "__main__":
    apart.program(__doc__, run, OUTCOMES, BAD)

"""Versions that are derived: computed again only if inputs, parameters or the code differ;
and the digest of that code.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from skindb.analysis.planning import sample_sizes
from skindb.analysis.studies import STUDIES
from skindb.analysis.study import of_cohort
from skindb.files import cache_folder, package_digest
from skindb.fit.model import second_pass
from skindb.schema import dataset
from skindb.store import Database
from skindb.workflow import cohorts, edits, fit
from skindb.workflow import derive as module
from skindb.workflow.cohorts import summary_parameters
from skindb.workflow.derive import Derivation, code_digest, derive

FILES = {
    "__init__.py": '''
"""A package."""
from typing import TYPE_CHECKING
import lazy_loader
if TYPE_CHECKING:
    from skindb import science
    from skindb.science.late import late
__getattr__, __dir__, _ = lazy_loader.attach(__name__, submodules=["science"])
''',
    "science/__init__.py": "from skindb.science.model import fit\n",
    "science/model.py": '''
"""A model."""
from __future__ import annotations
import numpy as np
from skindb import late, work
from skindb.science import plain
from skindb.science.parameters import Parameters

SCALE = 2.0
TABLE = "table.json"
NAMED = "dome/other.json"

def fit(values: np.ndarray, parameters: Parameters) -> np.ndarray:
    """Fit values."""
    from skindb.science._kernels import summed
    # a comment
    return SCALE * summed(values) + late() + plain.shift() + work.step() + len(TABLE)

def plot(values):
    return values
''',
    "science/table.json": '{"step": 1}',
    "science/parameters.py": """
from skindb.jit import option

class Parameters:
    k = option(4, "Number.", minimum=1)
""",
    "work/__init__.py": """
import lazy_loader
__getattr__, _, _ = lazy_loader.attach_stub(__name__, __file__)
""",
    "work/__init__.pyi": "from .steps import step\n",
    "work/steps.py": "def step():\n    return 5\n",
    "science/plain.py": "def shift():\n    return 1\n\ndef other():\n    return 2\n",
    "science/late.py": "def late():\n    return 3\n",
    "science/_kernels.py": """
from skindb.jit import kernel, overload

@kernel
def summed(values):
    total = 0.0
    for value in values:
        total += value
    return total

@overload(summed)
def _plain(values):
    return sum(values)
""",
    "science/unrelated.py": "raise RuntimeError('is never imported')\n",
    "jit.py": "def kernel(function):\n    return function\n\ndef overload(_):\n    return kernel\n",
    "store/__init__.py": "",
}
FIT = SimpleNamespace(__module__="skindb.science")
NNLS = ("numerics/_nnls_kernels.py", "MIN_PIVOT = 1e-11", "MIN_PIVOT = 1e-12")
TEXTURE = ("geometry/_atlas_kernels.py", "0.75 * near", "0.5 * near")


@pytest.fixture
def package(tmp_path, monkeypatch):
    root = tmp_path / "skindb"
    for name, text in FILES.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.setattr(module, "ROOT", root)
    return root


def _digest_after(package, monkeypatch, name, old, new):
    """The digest of a second copy of the package in which something was replaced."""
    copy = package.with_name("changed")
    shutil.copytree(package, copy)
    text = (copy / name).read_text()
    assert old in text
    (copy / name).write_text(text.replace(old, new))
    monkeypatch.setattr(module, "ROOT", copy)
    return code_digest(FIT)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("science/model.py", "SCALE * summed", "summed"),
        ("science/model.py", "SCALE = 2.0", "SCALE = 2.5"),
        ("science/_kernels.py", "total += value", "total -= value"),
        ("science/_kernels.py", "sum(values)", "max(values)"),
        ("science/_kernels.py", "@kernel\n", ""),
        ("science/parameters.py", "option(4", "option(5"),
        ("science/parameters.py", "minimum=1", "minimum=2"),
        ("science/late.py", "return 3", "return 4"),
        ("science/plain.py", "return 1", "return 0"),
        ("science/table.json", "1", "2"),
        ("work/steps.py", "return 5", "return 6"),
        ("jit.py", "return function", "return None"),
    ],
)
def test_code_digest__changes_with_everything_that_is_used(
    package, monkeypatch, name, old, new
):
    before = code_digest(FIT)
    assert _digest_after(package, monkeypatch, name, old, new) != before


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("science/model.py", "Fit values.", "Fit many values."),
        ("science/parameters.py", "Number.", "Number of bases."),
        ("science/model.py", "    # a comment\n", "\n\n"),
        ("science/model.py", "values: np.ndarray", "values: list[float]"),
        ("science/unrelated.py", "raise", "assert"),
        ("store/__init__.py", "", "LEASE = 3\n"),
    ],
)
def test_code_digest__does_not_depend_on_anything_else(
    package, monkeypatch, name, old, new
):
    before = code_digest(FIT)
    assert _digest_after(package, monkeypatch, name, old, new) == before


def test_code_digest__takes_the_function_of_a_partial(package):
    called = partial(lambda: None)
    called.func.__module__ = FIT.__module__
    assert code_digest(FIT) == code_digest(called)


def test_code_digest__of_a_study_is_that_of_its_function():
    computed = [study.compute for study in STUDIES.values()]
    assert code_digest(of_cohort("plan", sample_sizes)) == code_digest(sample_sizes)
    assert len({code_digest(compute) for compute in computed}) == len(STUDIES)


def test_code_digest__refuses_functions_of_other_packages():
    with pytest.raises(
        ValueError, match=r"shutil.copytree must be a function of skindb"
    ):
        code_digest(shutil.copytree)


def test_code_digest__covers_a_fit_are_science_with_its_kernels():
    modules = module._reached(module.ROOT, [module._module_of(second_pass)]).keys()
    assert {"skindb.numerics._nnls_kernels", "skindb.jit", "skindb.threads"} <= modules
    top = {name.split(".")[1] for name in modules - {"skindb"}}
    assert top.isdisjoint({"analysis", "render", "store", "workflow", "cli", "export"})


def test_code_digest__of_code_that_was_edited_meanwhile_is_not_stored(package):
    model = package / "science/model.py"
    before = code_digest(FIT)
    other = SimpleNamespace(__module__="skindb.science.model")
    plain = code_digest(other)
    module._parsed.cache_clear()
    module._digest_of.cache_clear()
    model.write_text(FILES["science/model.py"].replace("return values", "return None"))
    assert code_digest(other) != plain
    model.write_text(FILES["science/model.py"])
    for function in (module._parsed, module._digest_of, package_digest):
        function.cache_clear()
    assert (code_digest(other), code_digest(FIT)) == (plain, before)


def test_package_digest__ignores_locks_of_editors(package):
    before = package_digest(package)
    (package / "science/.#model.py").symlink_to("nobody@nowhere.1")
    package_digest.cache_clear()
    assert package_digest(package) == before


def test_cache_folder__without_a_home(monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("SKINDB_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert cache_folder() is None


def test_package_digest__changes_with_every_byte(package):
    before = package_digest(package)
    (package / "science/model.py").write_text(FILES["science/model.py"] + "#")
    package_digest.cache_clear()
    assert package_digest(package) != before


def _version(calls, **attrs):
    """A small version, and a note that it was computed."""
    calls.append(attrs)
    labels = dataset({"common_uv": np.zeros((3, 2), np.float32)})
    tree = xr.DataTree.from_dict({"registration": labels})
    tree.attrs = attrs
    return tree


@pytest.fixture
def db(tmp_path):
    db = Database(tmp_path / "db")
    for take in ("A", "B"):
        with db.stage("model", take) as stage:
            stage.commit({"consent_scope": ["statistics"]})
    return db


def _derived(db, calls, **changed):
    options = {
        "inputs": [db.record("model", take) for take in ("A", "B")],
        "code": cohorts.REGISTRATION_METHOD,
        "parameters": {"reference": ""},
        "names": ["A", "B"],
    }
    derivation = Derivation.of(db, "registration", "A", **options | changed)
    return derive(derivation, partial(_version, calls, take="A"))


def test_derive__computes_once(db):
    calls = []
    record = _derived(db, calls)
    assert _derived(db, calls) == record
    assert len(calls) == 1
    assert record.provenance["command"] == "register"
    assert [of["take"] for of in record.made_from] == ["A", "B"]


@pytest.mark.parametrize(
    "change", ["input", "parameters", "decisive", "code", "removal"]
)
def test_derive__computes_again_after_a_change(db, change_code, change):
    calls = []
    before = _derived(db, calls)
    changed = {}
    if change == "input":
        with db.stage("model", "B") as stage:
            stage.commit({"consent_scope": ["statistics"]})
    elif change == "parameters":
        changed = {"parameters": {"reference": "A"}}
    elif change == "decisive":
        changed = {"dictionary_digest": "d"}
    elif change == "code":
        change_code(*TEXTURE)
        change_code("geometry/warp.py", "return ", "return 1 and ")
    else:
        db.remove(before)
    after = _derived(db, calls, **changed)
    assert len(calls) == 2
    assert after.seal != before.seal


@pytest.mark.parametrize(
    ("method", "change"),
    [
        (fit.METHOD, NNLS),
        (cohorts.SUMMARY_METHOD, TEXTURE),
        (cohorts.REGISTRATION_METHOD, TEXTURE),
        (edits.METHOD, NNLS),
        (edits.METHOD, TEXTURE),
    ],
)
def test_method__depends_on_the_kernels_that_it_uses(method, change, change_code):
    before = code_digest(*method)
    change_code(*change)
    assert code_digest(*method) != before


def test_derivation__describes_only_what_was_derived_alike(db):
    models = [db.record("model", "A")]
    options = {"inputs": models, "code": cohorts.REGISTRATION_METHOD, "names": ["A"]}
    derivation = Derivation.of(db, "registration", "A", **options, parameters={"k": 1})
    assert derivation.current() is None
    record = derivation.commit(_version([]))
    assert derivation.current() == record
    other = Derivation.of(db, "registration", "A", **options, parameters={"k": 2})
    assert not other.describes(record)


def test_summary_parameters__name_the_code(change_code):
    before = summary_parameters()["digest"]
    change_code(*TEXTURE)
    assert summary_parameters()["digest"] != before

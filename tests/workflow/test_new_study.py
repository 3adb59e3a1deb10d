"""A study is a file, a name in a list and a declaration: a copy of skindb gets another one."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from planted_population import population

import skindb
from skindb.store import Database

STUDY = '''
"""Fraction of the skin that is lighter than a limit."""

from matplotlib import pyplot

from skindb.analysis.study import Study, table_of
from skindb.schema import dataset
from skindb.study_parameters import DECLARED


def compute(population, parameters):
    """The results of the study."""
    light = population.cohort["region_diffuse_reflectance"] > parameters.limit
    counts = light.sum(["region", "channel"]).values
    takes = [str(take) for take in population.cohort["take"].values]
    cells = {"coverage_count": counts.astype("int32")}
    return {"coverage": dataset(cells, coords={"cell": takes})}


def plot(table):
    """Plot the counts."""
    axes = pyplot.figure().subplots()
    axes.plot(table["coverage_count"])
    return axes


STUDY = Study(
    *DECLARED["lightness"],
    layout="tables",
    compute=compute,
    shown=("coverage",),
    tabulate=lambda table: table_of(table, ["coverage_count"], ["cell"]),
    plot=plot,
)
'''
RECORD = '''

@dataclass(frozen=True)
class LightnessParameters:
    """Parameters of the study."""

    limit: float = option(0.5, "Albedo of light skin.", minimum=0.0, maximum=1.0)


DECLARED["lightness"] = Declaration(
    "lightness", "fraction of light skin", LightnessParameters
)
'''
COMMAND = "from skindb.cli import main; main()"
NOTEBOOK = """
import skindb
db = skindb.open({url!r})
first = skindb.workflow.lightness(db, limit=0.25)
second = skindb.workflow.lightness(db, limit=0.25)
assert first.attrs["generation"] == second.attrs["generation"] == 1
assert first.attrs["study"] == "lightness.{key}", first.attrs["study"]
assert "Albedo of light skin" in skindb.workflow.lightness.__doc__
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Function that runs Python with a copy of skindb that has a further study."""
    folder = tmp_path_factory.mktemp("copy")
    package = folder / "skindb"
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(skindb.__file__).parent, package, ignore=ignored)
    (package / "analysis" / "lightness.py").write_text(STUDY)
    with (package / "study_parameters.py").open("a") as stream:
        stream.write(RECORD)
    studies = package / "analysis" / "studies.py"
    text = studies.read_text()
    text = text.replace(
        "from skindb.analysis.study ",
        "from skindb.analysis.lightness import STUDY as LIGHTNESS\n"
        "from skindb.analysis.study ",
    )
    # before that of coverage, whose variable it borrows
    studies.write_text(text.replace("        BRDF,\n", "        LIGHTNESS, BRDF,\n"))

    def run_python(*arguments):
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=False,
        )

    return run_python


@pytest.mark.slow
def test_new_study__is_a_command_a_function_and_a_stored_version(run, tmp_path):
    url = str(tmp_path / "db")
    for take, model in population().items():
        with Database(url).stage("model", take) as stage:
            stage.write(
                {name: one.to_dataset() for name, one in model.children.items()}
            )
            stage.commit(model.attrs)
    told = run("-c", COMMAND, "analyze", url, "lightness", "--help")
    assert "--limit" in told.stdout, told.stderr
    assert "--group-by" not in told.stdout
    assert run("-c", COMMAND, "analyze", url, "lightness", "--k", "3").returncode == 2
    plot = tmp_path / "a.png"
    arguments = ("--limit", "0.25", "--plot", str(plot), "--json")
    done = run("-c", COMMAND, "analyze", url, "lightness", *arguments)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["header"] == ["cell", "coverage_count"]
    assert [row[0] for row in report["rows"]] == sorted(population())
    assert plot.stat().st_size > 1000
    key = report["study"].removeprefix("lightness.")
    notebook = run("-c", NOTEBOOK.format(url=url, key=key))
    assert notebook.returncode == 0, notebook.stderr

"""The command line: mistakes give one line and the right exit code, and no traceback."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from unittest import mock

import click
import numpy as np
import pytest
from permissions import open_to_others
from planted_cohort import PEOPLE, database

import skindb
from skindb.analysis import STUDIES
from skindb.cli import cli, main
from skindb.cli.fitting import _fit_lines
from skindb.cli.shared import fault_lines
from skindb.errors import Fault
from skindb.render.image import read_exr
from skindb.study_parameters import DECLARED
from tests.pictures import read_png

COMMANDS = (
    "demo simulate calibrate capture check-device landmarks register-scan calibrate-cameras "
    "quick import ingest fit "
    "dictionary analyze tidy register reproduce edit render compare show export "
    "view consent release refresh withdraw info audit verify clean"
).split()


def _run_apart(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from skindb.cli import main; main()", *args],
        capture_output=True,
        text=True,
        check=False,
    )


def _run(*args: str) -> subprocess.CompletedProcess[str]:
    """Same result as `_run_apart`, but in this process, without new imports and tables
    for each call.
    """
    out = io.TextIOWrapper(io.BytesIO())
    err = io.TextIOWrapper(io.BytesIO())
    code: int | str | None = 0
    with (
        mock.patch.object(sys, "argv", ["skindb", *args]),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code
    assert code is None or isinstance(code, int)
    texts = []
    for stream in (out, err):
        stream.flush()
        texts.append(stream.buffer.getvalue().decode())  # type: ignore[attr-defined]
    return subprocess.CompletedProcess(args, code or 0, *texts)


@pytest.mark.parametrize(
    "args",
    [("info", "{tmp}", "--json"), ("info", "{tmp}/none", "--json"), ("nonsense",)],
)
def test_cli__a_call_gives_the_result_of_a_process(tmp_path, args):
    """The results are the same except for the name of the program."""
    args = [a.format(tmp=tmp_path) for a in args]
    call = _run(*args)
    process = _run_apart(*args)
    assert (call.returncode, call.stdout) == (process.returncode, process.stdout)
    assert call.stderr.splitlines()[-1:] == process.stderr.splitlines()[-1:]


# numbers that no memory depends on; k and rank are at most the materials of the dictionary
UNLIMITED = {
    "--generation",
    "--generations",
    "--k",
    "--rank",
    "--crop-box",
    "--crop-reach",
}


def test_cli__every_number_has_a_largest_value():
    for command in COMMANDS:
        ranges = [
            p
            for p in cli.commands[command].params
            if isinstance(p.type, click.IntRange | click.FloatRange)
        ]
        assert {p.opts[0] for p in ranges if p.type.max is None} <= UNLIMITED, command


@pytest.mark.parametrize(
    ("args", "code", "said"),
    [
        (
            ("simulate", "{tmp}", "--lights", "100000000"),
            2,
            "100000000 is not in the range 1<=x<=2048",
        ),
        (
            ("simulate", "{tmp}", "--width", "30000", "--height", "30000"),
            1,
            "width x height must be 1 to 8,000,000;",
        ),
        (
            ("simulate", "{tmp}", "--seed", "1" * 40),
            2,
            "is not in the range 0<=x<=1000000000",
        ),
        (
            ("ingest", "{tmp}", "{tmp}", "--workers", "100000"),
            2,
            "100000 is not in the range 1<=x<=256",
        ),
    ],
)
def test_cli__sizes_beyond_a_limit_are_one_line(tmp_path, args, code, said):
    done = _run(*(a.format(tmp=tmp_path / "new") for a in args))
    assert done.returncode == code
    assert said in done.stderr
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_cli__every_command_has_help_and_the_common_options(command):
    # each study has its own options
    study = ("DB", "brdf") if command == "analyze" else ()
    done = _run(command, *study, "--help")
    assert done.returncode == 0, done.stderr
    for option in ("--json", "--no-progress", "--verbose", "--actor"):
        assert option in done.stdout
    assert "None" not in done.stdout  # a range without bounds
    assert '""' not in done.stdout  # an empty default


@pytest.mark.parametrize(
    ("args", "code", "said"),
    [
        ((), 2, "Usage"),
        (("nonsense",), 2, "No such command"),
        (("fit",), 2, "Missing argument 'DB'"),
        (("info", "{tmp}/none"), 1, "the database must exist"),
        (("verify", "{tmp}/none"), 1, "the database must exist"),
        (
            ("info", "gs://bucket/x"),
            1,
            "a database must be a local folder or an S3 bucket",
        ),
        (("ingest", "{tmp}/db", "{tmp}/none"), 1, "none"),
        (
            ("ingest", "{tmp}/db", "{tmp}/none", "--crop-box", *"200000"),
            1,
            "lower corner must lie below",
        ),
        (("fit", "{tmp}/db"), 1, "the database must exist"),
        (("fit", "{tmp}/full"), 0, "no captures"),
        (("fit", "{tmp}/full", "X"), 1, "the database must hold it"),
        (("fit", "{tmp}/full", "--dictionary", "{tmp}"), 1, "MERL"),
        (
            ("fit", "{tmp}/full", "--dictionary", "{tmp}/full/notes.txt"),
            1,
            "must be an .npz file of plain arrays",
        ),
        (
            ("dictionary", "{tmp}/none.npz"),
            1,
            "a folder of MERL .binary files or an .npz file of BRDF tables",
        ),
        (
            ("analyze", "{tmp}/full", "albedo", "--plot", "{tmp}/a.abc"),
            1,
            "must end in .png",
        ),
        (
            ("analyze", "{tmp}/full", "traits", "--group-by", "gender"),
            2,
            "No such option '--group-by'",
        ),
        (
            ("analyze", "{tmp}/full", "albedo", "--adjust", "age"),
            2,
            "No such option '--adjust'",
        ),
        (("simulate", "{tmp}/new", "--condition", "lotion"), 1, "belongs to a cohort"),
        (("analyze", "{tmp}/full", "groups"), 2, "Missing option '--group-by'"),
        (("analyze", "{tmp}/full", "surface"), 2, "Missing option '--group-by'"),
        (
            ("analyze", "{tmp}/full", "surface", "--adjust", "age"),
            2,
            "No such option '--adjust'",
        ),
        (
            (
                "analyze",
                "{tmp}/full",
                "groups",
                "--group-by",
                "age",
                "--csv",
                "{tmp}/a.txt",
            ),
            1,
            "must end in .csv",
        ),
        (
            ("render", "{tmp}/full", "X", "--out", "{tmp}/none/a.exr"),
            1,
            "its folder must exist",
        ),
        (("analyze", "{tmp}/full", "traits"), 1, "a study needs fitted takes"),
        (("analyze", "{tmp}/db", "everything"), 2, "Invalid value"),
        (("register", "{tmp}/none"), 1, "the database must exist"),
        (("register", "{tmp}/full"), 1, "a study needs fitted takes"),
        (("edit", "{tmp}/db", "X", "--trait", "lotion"), 2, "NAME=AMOUNT"),
        (
            ("edit", "{tmp}/full", "X", "--trait", "lotion=1"),
            1,
            "must be a study of traits in the database",
        ),
        (
            ("render", "{tmp}/full", "X", "--out", "{tmp}/x.png"),
            1,
            "the database must hold it",
        ),
        (
            ("render", "{tmp}/full", "X", "Y", "--out", "{tmp}/x.png"),
            1,
            "2 takes: X, Y; name one take",
        ),
        (("fit", "{tmp}/full", "-x"), 2, "A name that begins with - follows after --."),
        (
            ("export", "{tmp}/full", "X", "--out", "{tmp}/x.glb"),
            1,
            "without --gltf it must be a folder",
        ),
        (
            ("render", "{tmp}/full", "--out", "{tmp}/x"),
            1,
            "there must be a take with a model",
        ),
        (("export", "{tmp}/full", "../X", "--out", "{tmp}/x"), 1, "take"),
        (
            ("demo", "--out", "{tmp}/full"),
            1,
            "must be absent, empty or from an earlier demo",
        ),
        (("demo", "--lights", "1"), 2, "Invalid value"),
    ],
)
def test_cli__mistakes_are_explained(tmp_path, args, code, said):
    (tmp_path / "full/log").mkdir(parents=True)
    (tmp_path / "full/notes.txt").write_text("keep me")
    done = _run(*(a.format(tmp=tmp_path) for a in args))
    assert done.returncode == code, done.stdout + done.stderr
    assert said in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "full/notes.txt").read_text() == "keep me"


def test_cli__info_of_an_empty_database_is_json(tmp_path):
    done = _run("info", str(tmp_path), "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout) == {"takes": {}}


def test_info__paths_of_a_subject_called_data(tmp_path):
    db = database(tmp_path / "data", {"data": PEOPLE["S01"]})
    said = _run("info", str(db.root), "-v").stdout
    paths = re.findall(r"data/\S+\.zarr", said)
    assert len(paths) >= 2
    assert all((db.root / path).is_dir() for path in paths), paths


def test_cli__custom_dictionary(tmp_path):
    """Half of the light is reflected; the file only has nodes, values and the fact that
    no value is missing.
    """
    nodes = {
        "theta_h": np.linspace(0, np.pi / 2, 5),
        "theta_d": np.linspace(0, np.pi / 2, 4),
        "phi_d": np.zeros(1),
    }
    np.savez(
        tmp_path / "own.npz",
        basis_brdf=np.full((1, 5, 4, 1), 0.5 / np.pi),
        names=np.array(["grey"]),
        **nodes,
    )
    done = _run("dictionary", str(tmp_path / "own.npz"), "--disc", "0", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    row = dict(zip(said["header"], said["rows"][0], strict=True))
    assert row["dictionary"] == "grey"
    assert row["normal_albedo"] == pytest.approx(0.5, rel=1e-3)
    # without a disc there is no error of the disc
    assert row["hole_fraction"] == 0


@pytest.fixture(scope="module")
def small_database(tmp_path_factory):
    """A database with a simulated take that was fitted by the command line."""
    out = tmp_path_factory.mktemp("cli")
    db = str(out / "db")
    size = "--takes 1 --cameras 3 --lights 12 --width 48 --height 60".split()
    made = _run("simulate", str(out / "c"), *size)
    assert made.returncode == 0, made.stderr
    taken = _run("ingest", db, str(out / "c/V001"), "--spacing", "6")
    assert taken.returncode == 0
    assert re.search(
        r"samples per surfel: mean \d+ \(p5 \d+, .* of 36; \d+% of [\d,]+ surfels have any",
        taken.stdout,
    )
    [chosen] = re.findall(r"^ +chosen: refine o(?:n|ff).*$", taken.stdout, re.M)
    done = _run(
        "fit", db, "--json", "--hold-out-lights", "0.01", "--hold-out-cameras", "0.01"
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)["V001"]
    assert (
        report["prediction"]["regions"]["face"]["held_out_cameras"]["linear"]["median"]
        > 0
    )
    said = _run("info", db, "-v").stdout
    assert "unseen cameras" in said
    assert re.search(
        r"R_d \+- error +trusted .*\n +face +\d+( +0\.\d+ \+- 0\.\d+){3}", said
    )
    assert re.search(r"samples of +mean +p5 +p50 +p95 +max +seen\n +all ", said)
    assert chosen.strip() in said
    # a tenth of the lights is one light
    assert len(report["held_out_lights"]) == len(report["held_out_cameras"]) == 1
    return out, db


@pytest.mark.slow
def test_cli__captures_and_databases_belong_to_their_owner_alone(small_database):
    out, _ = small_database
    assert open_to_others(out, itself=False) == {}


@pytest.mark.slow
def test_cli__fit_processes_takes_without_a_model_of_their_newest_capture(
    small_database, tmp_path
):
    out, db = small_database
    assert "every take has a model" in _run("fit", db).stderr
    copy = str(shutil.copytree(db, tmp_path / "db"))
    done = _run("ingest", copy, str(out / "c/V001"), "--spacing", "5")
    assert done.returncode == 0
    assert list(json.loads(_run("fit", copy, "--explain", "--json").stdout)) == ["V001"]


@pytest.mark.slow
def test_cli__ingest_and_fit_refuse_what_a_subject_withdrew(small_database, tmp_path):
    out, db = small_database
    copy = str(tmp_path / "db")
    shutil.copytree(db, copy)
    assert _run("consent", copy, "V001", "--scope", "statistics").returncode == 0
    for command in (
        ("ingest", copy, str(out / "c/V001"), "--spacing", "5"),
        ("fit", copy, "V001"),
    ):
        done = _run(*command)
        assert done.returncode == 1
        assert (
            "V001: consent_scope: this step needs the scope 'fit'; found only statistics"
            in done.stderr
        )
    assert len(skindb.open(copy).history("capture", "V001")) == len(
        skindb.open(db).history("capture", "V001")
    )


@pytest.mark.slow
def test_cli__fit_refuses_too_many_components_before_it_starts(small_database):
    _, db = small_database
    done = _run("fit", db, "V001", "--k", "100")
    assert done.returncode == 1
    assert "1 to 67 components" in done.stderr


@pytest.mark.slow
def test_cli__explain_plans_and_does_not_work(small_database, tmp_path):
    _, db = small_database
    versions = _run("info", db).stdout
    (line,) = [
        line
        for line in json.loads(_run("fit", db, "V001", "--explain", "--json").stdout)[
            "V001"
        ]
        if "rank" in line
    ]
    assert "43 of 67 are skipped (rank 16, beside 8 exact lobes); mixtures" in line
    assert _run("info", db).stdout == versions
    call = (
        "render",
        db,
        "V001",
        "--out",
        str(tmp_path / "a.png"),
        "--light",
        "l000",
        "--subsurface",
        "--size",
        "80",
    )
    planned = _run(*call, "--explain").stdout.strip()
    assert "results stay the same" in planned
    assert not list(tmp_path.iterdir())
    lines = planned.splitlines()
    skipped = json.loads(_run(*call, "--json").stdout)["V001"]["skipped"]
    assert skipped == lines[: len(skipped)]
    assert all(line.startswith("not skipped: ") for line in lines[len(skipped) :])
    assert _run(*call, "-v").stdout.startswith(f"plan: {planned.splitlines()[0]}")


@pytest.mark.slow
def test_cli__a_variable_is_drawn_from_the_model_or_else_the_capture(
    small_database, tmp_path
):
    _, db = small_database
    for variable, at, kind in (
        ("diffuse_reflectance", ("--at", "channel=G"), "model"),
        ("sample_count", (), "capture"),
    ):
        picture = tmp_path / f"{variable}.png"
        told = json.loads(
            _run("show", db, "V001", variable, str(picture), *at, "--json").stdout
        )
        assert (told["kind"], told["path"]) == (kind, str(picture))
        assert np.ptp(read_png(picture)) > 200
    for call, said in (
        (("V001", "sample_count", "--at", "x"), "--at needs DIMENSION=LABEL"),
        (
            ("V001", "nose"),
            "found nose; choose basis_weight, basis_weight_error, camera_visible_fraction",
        ),
        (("V009", "sample_count"), "found V009; choose V001"),
        (("V001", "dictionary_weight"), "choose dictionary="),
    ):
        done = _run("show", db, *call[:2], str(tmp_path / "none.png"), *call[2:])
        assert done.returncode > 0
        assert said in done.stderr
    assert not (tmp_path / "none.png").exists()


@pytest.mark.slow
def test_cli__many_takes_at_a_time(tmp_path):
    """From simulation to pictures in two processes; a failing take does not stop the
    others; a refit resumes.
    """
    db = str(tmp_path / "db")
    two = ("--workers", "2")
    size = (
        "--takes",
        "2",
        "--cameras",
        "3",
        "--lights",
        "12",
        "--width",
        "48",
        "--height",
        "60",
    )
    folders = json.loads(
        _run("simulate", str(tmp_path / "c"), *size, *two, "--json").stdout
    )
    assert [folder.rpartition("/")[2] for folder in folders] == ["V001", "V001.lotion"]
    taken = _run("ingest", db, *folders, str(tmp_path / "none"), "--spacing", "6", *two)
    assert taken.returncode == 1
    assert "2 of 3 captures were ingested" in taken.stderr
    assert {
        line.partition(":")[0]
        for line in taken.stdout.splitlines()
        if "capture 1" in line
    } == {
        "V001",
        "V001.lotion",
    }
    done = json.loads(_run("fit", db, *two, "--k", "2", "--json").stdout)
    assert {take: report["generation"] for take, report in done.items()} == {
        "V001": 1,
        "V001.lotion": 1,
    }
    call = ("fit", db, "V001", "--eta", "1.35", "--light-gains", "off", "--json")
    plain = json.loads(_run(*call).stdout)
    parameters = plain["V001"]["parameters"]
    assert (parameters["k"], parameters["eta"]) == (2, 1.35)
    assert not parameters["light_gains"]
    refused = _run("analyze", db, "translucency")
    assert refused.returncode == 1
    assert (
        "parameter eta: the takes of a study are fitted with the same parameters"
        in refused.stderr
    )
    again = json.loads(
        _run("fit", db, "--refit", "--eta", "1.35", *two, "--json").stdout
    )
    assert {take: report["parameters"]["eta"] for take, report in again.items()} == {
        "V001.lotion": 1.35
    }
    assert again["V001.lotion"]["parameters"]["k"] == 2  # its own
    assert (
        "every take has a model with these parameters"
        in _run("fit", db, "--refit", "--eta", "1.35").stderr
    )
    picture = ("--light", "l000", "--spp", "8", "--size", "80")
    assert (
        _run(
            "render", db, "--out", str(tmp_path / "pictures"), *picture, *two
        ).returncode
        == 0
    )
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {
        "V001.png",
        "V001.lotion.png",
    }
    table = tmp_path / "table.csv"
    said = _run("analyze", db, "translucency", "--csv", str(table))
    assert "status of the profiles: " in said.stdout
    assert table.read_text().startswith("group,site,channel,sigma_tr_count,")
    said = _run("analyze", db, "groups", "--group-by", "condition")
    assert "lotion less normal: one subject" in said.stdout


@pytest.mark.slow
def test_cli__json_is_strict(small_database):
    """Unknown intervals in a table of one take are null, because JSON has no NaN."""
    _, db = small_database
    done = _run("analyze", db, "translucency", "--json")
    assert done.returncode == 0, done.stderr

    def refuse(word):
        raise AssertionError(word)

    rows = json.loads(done.stdout, parse_constant=refuse)["rows"]
    assert any(None in row for row in rows)


@pytest.mark.slow
def test_cli__demo_keeps_files_that_it_did_not_create(small_database, tmp_path):
    out, _ = small_database
    folder = tmp_path / "demo"
    folder.mkdir()
    (folder / ".skindb-demo").touch()
    capture = out / "c/V001/capture.json"
    ours = json.loads(capture.read_text())
    capture.write_text(json.dumps(ours | {"subject": "MINE"}))
    assert (
        _run(
            "ingest", str(folder / "db"), str(capture.parent), "--spacing", "5"
        ).returncode
        == 0
    )
    capture.write_text(json.dumps(ours))
    done = _run("demo", "--out", str(folder), "--takes", "1")
    assert done.returncode == 1
    assert "MINE" in done.stderr
    assert (folder / "db/log/capture/MINE").is_dir()


@pytest.mark.parametrize("module", ["skindb", "skindb.cli"])
def test_import__is_fast_and_does_nothing(module):
    """Numba, dask and zarr are not imported at the start, but by the functions that need them."""
    heavy = {"numba", "dask", "zarr", "xarray", "matplotlib", "sklearn"}
    code = f"import sys, {module}; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


HELP_OF_ALL = """
import sys
from click.testing import CliRunner
from skindb.cli import cli
from skindb.study_parameters import DECLARED
run = CliRunner().invoke
calls = [[], *([name] for name in cli.commands)]
calls += [["analyze", "db", study] for study in DECLARED]
assert not any(run(cli, [*call, "--help"]).exit_code for call in calls)
heavy = {"numpy", "dask", "zarr", "xarray", "matplotlib"}
science = {"analysis", "fit", "render", "reflectance", "optics", "geometry", "numerics"}
print(sorted((heavy | {f"skindb.{name}" for name in science}) & set(sys.modules)))
"""


def test_help__of_every_command_and_study_imports_no_science():
    done = subprocess.run(
        [sys.executable, "-c", HELP_OF_ALL], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


METADATA = """
import sys
from click.testing import CliRunner
from skindb.cli import cli
for command, *more in (["info"], ["audit"], ["release"], ["consent", "S01"]):
    result = CliRunner().invoke(cli, [command, sys.argv[1], *more])
    assert result.exit_code == 0, result.output
heavy = {"numba", "scipy", "sklearn", "dask", "matplotlib"}
science = {"analysis", "fit", "render", "reflectance", "optics", "geometry", "numerics"}
print(sorted((heavy | {f"skindb.{name}" for name in science}) & set(sys.modules)))
"""


def test_commands_that_read_only_records__import_no_science(fitted_database):
    done = subprocess.run(
        [sys.executable, "-c", METADATA, fitted_database.url],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"


def test_declared_studies__are_those_that_exist():
    assert [*DECLARED] == [*STUDIES]


@pytest.mark.slow
def test_import__of_methods_needs_no_plots_no_colour_science_and_no_learning():
    """Every process of a run imports the methods, and these packages would double the
    time for that.
    """
    code = (
        "import sys, skindb.analysis, skindb.fit, skindb.ingest, skindb.render.rendering; "
        "print({'colour', 'matplotlib', 'sklearn'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"


def test_suspect_line__says_what_and_asks_why():
    from skindb.cli.fitting import _suspect_line

    light = _suspect_line({"light": "l017", "outlier_fraction": 0.624, "misfit": 2.54})
    assert light == (
        "light l017: 62% of its samples are outliers, residuals 2.5 times noise "
        "(did the face move?)"
    )
    assert "camera c03: 11% " in _suspect_line(
        {"camera": "c03", "outlier_fraction": 0.11, "misfit": 2.2}
    )


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (("fit", "db", "--eta", "nan"), "is not a finite number"),
        (("ingest", "db", "c", "--spacing", "inf"), "inf is not in the range"),
    ],
)
def test_cli__an_invalid_number_is_bad_usage(call, said):
    done = _run(*call)
    assert done.returncode == 2
    assert said in done.stderr


@pytest.mark.parametrize("command", ["info", "verify"])
def test_cli__a_folder_that_is_no_database_is_not_an_empty_one(command, tmp_path):
    (tmp_path / "notes.txt").touch()
    done = _run(command, str(tmp_path))
    assert done.returncode == 1
    assert "a database must have a log; found a folder without" in done.stderr


def test_fault_lines__many_of_one_rule_are_folded():
    faults = [Fault(f"frame {i}", "must exist", "nothing") for i in range(30)] + [
        Fault("mesh", "is closed", "open")
    ]
    lines = fault_lines(faults, unlimited=False)
    assert len(lines) == 12
    assert "is closed" in lines[-2]
    assert lines[-1] == "and 20 more: must exist (-v lists them)"
    assert len(fault_lines(faults, unlimited=True)) == 31


@pytest.mark.slow
def test_fit__faults_say_which_take_they_are_of(small_database):
    _, db = small_database
    done = _run("fit", db, "V001", "--rank", "0")
    assert done.returncode == 2
    done = _run("fit", db, "V001", "--k", "99")
    assert (
        "V001: k: a reduced basis of this dictionary has 1 to 67 components"
        in done.stderr
    )


@pytest.mark.slow
def test_fit__an_unknown_take_is_refused_before_others_are_fitted(small_database):
    _, db = small_database
    done = _run("fit", db, "V001", "v01", "--explain")
    assert (done.returncode, done.stdout) == (1, "")
    said = "capture of v01: the database must hold it; found v01; did you mean V001?"
    assert said in done.stderr


@pytest.mark.parametrize(
    ("args", "code", "what"),
    [
        (("info", "{tmp}/none"), 1, "none"),
        (("ingest", "{tmp}/db", "{tmp}/none"), 1, "none/capture.json"),
        (("fit", "{tmp}/full", "X"), 1, "capture of X"),
        (("analyze", "{tmp}/full", "everything"), 2, " analyze"),
        (("nonsense",), 2, ""),
    ],
)
def test_cli__a_failure_is_one_json_object(tmp_path, args, code, what):
    """With --json every failure has place, rule, finding and cure; the line for people
    is still printed.
    """
    (tmp_path / "full/log").mkdir(parents=True)
    done = _run(*(a.format(tmp=tmp_path) for a in args), "--json")
    told = json.loads(done.stdout)
    assert (done.returncode, set(told)) == (code, {"error"})
    assert [set(one) for one in told["error"]] == [
        {"what", "rule", "found", "cure"}
    ] * len(told["error"])
    assert what in told["error"][0]["what"]
    assert told["error"][0]["found"].splitlines()[0].split(": ")[-1] in done.stderr


@pytest.mark.slow
def test_cli__successes_are_reported_beside_failures(fitted_database):
    (fitted_database.root / "log/capture/S02/00000001.json").write_text("{")
    call = ("fit", fitted_database.url, "S01", "S02", "--dictionary", "embedded")
    done = _run(*call, "--explain", "--json")
    assert done.returncode == 1
    told = json.loads(done.stdout)
    assert set(told) == {"error", "done"}
    assert list(told["done"]) == ["S01"]
    assert "S02" in told["error"][0]["what"]


@pytest.mark.slow
def test_cli__unknown_keys_of_a_capture_are_named(small_database, tmp_path):
    out, _ = small_database
    shutil.copytree(out / "c/V001", tmp_path / "c")
    file = tmp_path / "c/capture.json"
    data = json.loads(file.read_text())
    data["region"] = data.pop("regions")
    file.write_text(json.dumps(data | {"operator": "me"}))
    done = _run("ingest", str(tmp_path / "db"), str(tmp_path / "c"), "--spacing", "5")
    assert done.returncode == 0, done.stderr
    said = (
        "V001: warning: unknown keys of capture.json, kept but not read: operator, "
        "region (did you mean regions?)"
    )
    assert said in done.stderr.splitlines()


@pytest.mark.slow
def test_cli__an_earlier_generation_is_shown(small_database, tmp_path):
    """The second model is ten times darker, so that the picture shows which generation was read."""
    _, db = small_database
    database = skindb.open(db)
    model = database.read("model", "V001")
    first_generation = database.record("model", "V001").generation
    groups = {
        str(name): node.to_dataset().load() for name, node in model.children.items()
    }
    for name in ("diffuse_reflectance", "basis_weight"):
        groups["fitted"][name] = groups["fitted"][name] * 0.1
    with database.stage("model", "V001") as stage:
        stage.write(groups)
        stage.commit(model.attrs)
    old = ("--generation", str(first_generation))
    picture = ("--light", "l000", "--size", "48", "--spp", "8")
    for name, more in (("new", ()), ("old", old)):
        assert (
            _run(
                "render",
                db,
                "V001",
                "--out",
                str(tmp_path / f"{name}.exr"),
                *picture,
                *more,
            ).returncode
            == 0
        )
        out = str(tmp_path / name)
        assert (
            _run(
                "export", db, "V001", "--out", out, "--no-merl", "--size", "16", *more
            ).returncode
            == 0
        )
    new, first = (
        read_exr(tmp_path / f"{name}.exr")[0][..., :3].mean() for name in ("new", "old")
    )
    assert 5 < first / new < 11
    assert (
        json.loads((tmp_path / "old/V001/manifest.json").read_text())["provenance"][
            "generation"
        ]
        == first_generation
    )
    new, first = (
        json.loads(_run("compare", db, "V001", "--json", *more).stdout)
        for more in ((), old)
    )
    assert (
        min(c["relative_rmse"] for c in new)
        > 0.8
        > max(c["relative_rmse"] for c in first)
    )
    assert (
        "generation 99 must exist"
        in _run("compare", db, "V001", "--generation", "99").stderr
    )
    inside = _run("export", db, "V001", "--out", str(database.root / "exported"))
    assert inside.returncode == 1
    assert "exports are written outside of the database" in inside.stderr


@pytest.mark.parametrize(("median", "said"), [(0.05, False), (0.5, True)])
def test_fit_lines__gains_translucency_and_a_model_that_explains_no_photographs(
    median, said
):
    report = {
        "seconds": {"surface": 1.0},
        "status": {"fitted": 0.9},
        "generation": 1,
        "surfels": 9,
        "suspects": [],
        "skipped": [],
        "fit_residual": {"median": median, "p95": 0.9},
        "light_gains": {"spread": 0.02, "gain": 1.1, "light": "l003"},
        "translucency": {
            "cheek": {
                "sigma_tr": [0.5, 0.7, None],
                "total_error": [0.1, 0.1, None],
                "status": ["fitted", "fitted", "dark"],
            }
        },
    }
    with click.Context(click.Command("fit")) as context:
        context.meta["verbose"] = False
        lines = _fit_lines(report)
    assert lines[0].startswith("fit residual of unobstructed surfels: median ")
    assert (
        any(
            "does not explain the photographs: check the camera poses" in line
            for line in lines
        )
        is said
    )
    assert (
        "sigma_tr of cheek: R 0.5 +- 0.1, G 0.7 +- 0.1, B unknown mm-1 (fitted, dark)"
        in lines
    )
    assert (
        "gains of the lights: standard deviation 2.0%; the farthest from 1 is 1.10, of "
        "light l003"
    ) in lines

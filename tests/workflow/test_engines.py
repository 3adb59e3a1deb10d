"""Results do not depend on where takes are worked on, on the number of workers, or on
the order of the takes.
"""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial

import pytest
from threadpoolctl import threadpool_limits

import skindb
from skindb.analysis import principal_components
from skindb.workflow import (
    albedo,
    brdf,
    computing_on,
    connected,
    fit_with,
    ingest_take,
    map_takes,
    register_takes,
    results_of,
    simulate,
    traits,
)
from skindb.workflow.derive import groups_of

pytestmark = pytest.mark.slow

SMALL = {"takes": 2, "cameras": 3, "lights": 12, "width": 48, "height": 60}
GIVEN = {"k": 2, "hold_out_lights": 0.1}
# seals of the inputs hold their time of creation
OF_THE_RUN = ("seconds", "created", "inputs")


@pytest.fixture(scope="module", autouse=True)
def _several_blas_threads():
    """As in a separate process; results must not depend on it."""
    with threadpool_limits(2):
        yield


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("captures"), **SMALL)


@pytest.fixture(scope="module")
def address():
    options = {
        "n_workers": 2,
        "threads_per_worker": 1,
        "dashboard_address": "127.0.0.1:0",
    }
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(**options) as cluster:
        yield cluster.scheduler_address


def _filled(root, captures, **where):
    """A database of captures, models and registrations."""
    db = skindb.open(str(root))
    list(
        results_of(
            map_takes(partial(ingest_take, db, spacing_mm=6.0), captures, **where)
        )
    )
    takes = db.takes("capture")[:: -1 if "client" in where else 1]
    list(results_of(map_takes(partial(fit_with, db, given=GIVEN), takes, **where)))
    register_takes(db, **where)
    with computing_on(where.get("client"), db.root):
        brdf(db)
        traits(db, k=3)
        albedo(db, group_by="gender")
    return db


def _contents(db):
    """Digest of every file of every version; provenance is compared without the values
    of the run.
    """
    found = {}
    for kind in db.kinds():
        for take in db.takes(kind):
            record = db.record(kind, take)
            manifest = json.loads((db.root / record.beside("manifest")).read_text())
            digests = {
                name: digest
                for name, (digest, _) in manifest.items()
                if name != "zarr.json"
            }
            about = {
                name: value
                for name, value in record.provenance.items()
                if name not in OF_THE_RUN
            }
            made_from = [
                [one.get(name) for name in ("kind", "take", "generation")]
                for one in record.made_from
            ]
            found[kind, take] = (
                digests,
                about,
                made_from,
                record.contents,
                record.tables,
            )
    return found


@pytest.mark.slow
def test_map_takes__the_same_bytes_on_every_engine_and_in_any_order(
    captures, address, tmp_path, small_textures
):
    expected = _contents(_filled(tmp_path / "here", captures))
    assert len(expected) == 11  # two takes of four kinds, three studies
    assert min(len(digests) for digests, *_ in expected.values()) > 5
    assert _contents(_filled(tmp_path / "processes", captures, workers=2)) == expected
    faces = skindb.open(str(tmp_path / "here")).cohort("maps").texel_diffuse_reflectance
    whole = principal_components(faces)
    with connected(address) as client:
        with computing_on(client):
            assert principal_components(faces).equals(whole)
        assert (
            _contents(_filled(tmp_path / "cluster", captures[::-1], client=client))
            == expected
        )


@pytest.mark.slow
def test_fit__a_driver_that_is_killed_continues_with_what_is_not_done(
    captures, address, tmp_path
):
    db = skindb.open(str(tmp_path / "db"))
    ingest_take(db, captures[0], spacing_mm=6.0)
    capture = db.read("capture", "V001")
    for take in ("V002", "V003", "V004", "V005", "V006"):
        with db.stage("capture", take) as stage:
            stage.write(groups_of(capture))
            stage.commit(capture.attrs | {"subject": take})
    command = [
        sys.executable,
        "-c",
        "from skindb.cli import main; main()",
        "fit",
        str(db.root),
        "--k",
        "2",
    ]
    command += ["--scheduler", address, "--json", "--progress", "json"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as driver:
        assert driver.stderr is not None
        finished = next(
            json.loads(line)["take"] for line in driver.stderr if '"finished"' in line
        )
        driver.kill()
    done = {take for take in db.takes("model") if db.history("model", take)}
    # a worker may still fit a take of the killed driver
    run = subprocess.run(
        [*command, "--wait", "60"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    again = json.loads(run.stdout)
    assert finished in done
    assert 0 < len(again) <= 6 - len(done)
    assert not done & set(again)
    assert db.takes("model") == db.takes("capture")
    assert len(db.history("model", finished)) == 1

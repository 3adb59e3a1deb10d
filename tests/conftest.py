"""Shared fixtures. Property tests use the same examples in every run;
HYPOTHESIS_PROFILE=search draws new ones.
"""

from __future__ import annotations

import gc
import os
import shutil
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from bucket_server import new_bucket, s3_server
from bucket_server import settings as bucket_settings
from hypothesis import settings

import skindb
from skindb.threads import one_blas_thread

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("search", derandomize=False, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# files of more than a minute
LONGEST = {
    "test_destructive",
    "test_rig",
    "test_takes",
    "test_viewer_page",
    "test_suspended_writers",
    "test_hostile_disc",
    "test_cli",
    "test_bucket",
    "test_withdraw",
}


def pytest_configure():
    """Modules and items live until the end: the collector of garbage need not look at them."""
    gc.disable()


def pytest_collection_finish():
    """See `pytest_configure`."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items):
    """Tests with the server of a bucket are outside `make test`; the longest files come
    first, so that no worker has one of them left at the end.
    """
    for item in items:
        if "s3_address" in item.fixturenames:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: item.path.stem not in LONGEST)


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    """Threads of BLAS wait for each other in loops, which takes the cores from the
    other workers of the tests.
    """
    with one_blas_thread():
        yield


@pytest.fixture(scope="session", autouse=True)
def _do_not_wait_for_the_disk():
    """What was flushed only shows after a power loss: tests/destructive/power_loss.py,
    a process of its own.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)  # which also needs an open file
        yield


@pytest.fixture(autouse=True)
def _close_figures():
    """Otherwise Matplotlib warns about the many figures of other tests."""
    yield
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


# the fixtures below import what they make, because a run of other tests needs none of it


@pytest.fixture(scope="session")
def pristine(tmp_path_factory):
    """Capture folder of a sphere, which is only copied."""
    from sphere import write_capture

    folder = tmp_path_factory.mktemp("capture") / "T001"
    write_capture(folder)
    return folder


@pytest.fixture
def capture_folder(pristine, tmp_path):
    """A capture folder of a sphere, to be changed."""
    return Path(shutil.copytree(pristine, tmp_path / "T001"))


@pytest.fixture(scope="session")
def skin(new_skin):
    return new_skin()


@pytest.fixture(scope="session")
def new_skin():
    from planted_skin import make_skin

    return make_skin


@pytest.fixture(scope="session")
def small_dictionary():
    """Six of the embedded materials."""
    from skindb.reflectance.dictionary import Dictionary, embedded_dictionary

    whole = embedded_dictionary()
    chosen = [3, 12, 20, 31, 44, 57]
    table = np.ascontiguousarray(whole.table[..., chosen])
    return Dictionary(
        tuple(whole.names[i] for i in chosen), table, whole.grid, "six of them"
    )


@pytest.fixture(scope="session")
def plant():
    from planted_skin import plant_skin

    return plant_skin


@pytest.fixture(scope="session")
def fitted_takes(tmp_path_factory):
    """Folder of a database of three fitted takes of two subjects, which is only copied."""
    from planted_cohort import PEOPLE, database

    people = {take: PEOPLE[take] for take in ("S01", "S01.lotion", "S02")}
    return database(tmp_path_factory.mktemp("fitted"), people).root


@pytest.fixture
def fitted_database(fitted_takes, tmp_path):
    """A database of three fitted takes of two subjects: S01, S01.lotion, S02."""
    return skindb.open(str(shutil.copytree(fitted_takes, tmp_path / "db")))


@pytest.fixture(scope="module")
def browser():
    """A headless browser, of one file only: until it is closed, `asyncio` is in use."""
    from browser_page import started_browser

    with started_browser() as browser:
        yield browser


@pytest.fixture(scope="session")
def s3_address():
    """Function that returns the address of a kind of server, which is started at its first use."""
    with ExitStack() as stack:
        started = {}

        def address(kind):
            if kind not in started:
                started[kind] = stack.enter_context(s3_server(kind))
            return started[kind]

        yield address


@pytest.fixture
def new_database(s3_address, monkeypatch, tmp_path_factory):
    """Function that returns the URL of a new database in a bucket; the environment is
    set for its server.
    """
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("share")))

    def url(kind):
        address = s3_address(kind)
        for name, value in bucket_settings(address).items():
            monkeypatch.setenv(name, value)
        return f"s3://{new_bucket(address)}/laboratory/faces"

    return url


@pytest.fixture
def bucket(new_database):
    """URL of a new database in a bucket."""
    return new_database("localbucket")

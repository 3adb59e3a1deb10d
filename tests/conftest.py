"""Shared fixtures. Property tests use the same examples in every run; HYPOTHESIS_PROFILE=search draws new ones."""

from __future__ import annotations

import os
from contextlib import ExitStack

import numpy as np
import pytest
from bucket_server import new_bucket, s3_server
from bucket_server import settings as bucket_settings
from hypothesis import settings
from planted_skin import make_skin, plant_skin

from skindb.optics.dictionary import Dictionary, embedded_dictionary

settings.register_profile("same", derandomize=True)
settings.register_profile("search", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


@pytest.fixture(scope="session")
def skin():
    return make_skin()


@pytest.fixture(scope="session")
def new_skin():
    return make_skin


@pytest.fixture(scope="session")
def small_dictionary():
    """Six of the embedded materials."""
    whole = embedded_dictionary()
    chosen = [3, 12, 20, 31, 44, 57]
    table = np.ascontiguousarray(whole.table[..., chosen])
    return Dictionary(tuple(whole.names[i] for i in chosen), table, whole.grid, "six of them")


@pytest.fixture(scope="session")
def plant():
    return plant_skin


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
def new_database(s3_address, monkeypatch):
    """Function that returns the URL of a new database in a bucket; the environment is set for its server."""

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

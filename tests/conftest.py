"""Property tests draw the same examples in every run; HYPOTHESIS_PROFILE=search draws new ones."""

from __future__ import annotations

import os

import numpy as np
import pytest
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

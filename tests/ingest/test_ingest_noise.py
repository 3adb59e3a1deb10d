"""The noise that ingest states of samples is the one that repeated photographs have."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import skindb
from skindb import workflow

sys.path.append(str(Path(__file__).parent))
from sphere import CAMERAS, LIGHTS, SECONDS, expose, face_radiance, save, write_capture


def _samples(tmp_path, name, folder):
    db = skindb.open(str(tmp_path / name))
    workflow.ingest_take(db, folder)
    return db.read("capture", "T001")["samples"].to_dataset().load()


@pytest.mark.slow
def test_ingest__differences_of_repeated_photographs_are_as_large_as_the_stated_noise(
    tmp_path,
):
    first = tmp_path / "first"
    write_capture(first)
    second = Path(shutil.copytree(first, tmp_path / "second"))
    rng = np.random.default_rng(2)
    for camera, eye in CAMERAS.items():
        for exposure, seconds in SECONDS.items():
            for light, place in LIGHTS.items():
                frame = expose(face_radiance(eye, place), seconds, rng)
                save(second / f"dome/frames/{exposure}/{light}_{camera}.png", frame)
    one = _samples(tmp_path, "db1", first)
    two = _samples(tmp_path, "db2", second)
    a, b = (
        samples["reflectance_sample"].values.astype(np.float64)
        for samples in (one, two)
    )
    level = (a + b) / 2
    stated = np.sqrt(
        4 / 9 * float(one["noise_floor"]) ** 2
        + float(one["shot_noise"]) * np.maximum(level, 0)
    )
    z = ((a - b) / np.sqrt(2) / stated)[np.isfinite(level) & (level > 0.02)]
    assert z.size > 10_000
    # intensities of lights and distances differ from the median ones by a third, half
    # floats round to 0.05 %
    assert 0.8 < 1.4826 * np.median(np.abs(z)) < 1.25
    assert float(two["shot_noise"]) > 0

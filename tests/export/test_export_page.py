"""The program in the guide to exports, which knows the files of a bundle only, computes
what skindb computes.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

import skindb
from skindb.export import export_bundle

PAGE = Path(__file__).parents[2] / "docs/howto/export.md"
# relative; both interpolate the same tables, the page linearly in the angles, skindb in
# the root of theta_h
TOLERANCE = 1e-3


def _program():
    """The block of the page that defines `reflectance`."""
    (block,) = [
        b
        for b in re.findall(
            r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.S | re.M
        )
        if "interpn" in b
    ]
    return block


def test_export_page__reflectance_is_that_of_skindb(model, tmp_path, monkeypatch):
    model.attrs["parameters"] = {"k": 2, "eta": float(model["fitted/refractive_index"])}
    export_bundle(model, tmp_path / "bundle/P001", size=512, merl=False)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(_program(), names)
    fitted = model["fitted"].to_dataset()
    surfel = int(np.flatnonzero(fitted["fit_status"].values == 0)[100])
    weights = fitted["basis_weight"].values[surfel].astype(float)
    values = {f"weight_{k}": weights[k : k + 1] for k in range(len(weights))}
    values["normal"] = fitted["shading_normal"].values[surfel].astype(float)
    values["albedo"] = fitted["diffuse_reflectance"].values[surfel].astype(float)
    # the functions of the page look it up here
    names["texel"] = lambda name, _i, _j: values[name]
    draws = np.random.default_rng(3)
    compared = 0
    for light, camera in draws.standard_normal((60, 2, 3)):
        light = light / np.linalg.norm(light)
        camera = camera / np.linalg.norm(camera)
        if min(light @ values["normal"], camera @ values["normal"]) > 0.2:
            expected = skindb.render.evaluate(model, surfel, light, camera)
            np.testing.assert_allclose(
                names["reflectance"](0, 0, light, camera), expected, rtol=TOLERANCE
            )
            compared += 1
    assert compared > 5

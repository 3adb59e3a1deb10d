"""Coverage of the errors that albedo and normals state, where the model is true (some minutes).

    python benchmarks/albedo_errors.py

Samples as in `skindb bench --only albedo`, which has the errors by method and number of samples. Prints JSON.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from skindb.bench.photometry import ETA, SCAN_ERROR, model_samples
from skindb.fit import estimate_diffuse_reflectance, estimate_normals

ISOTROPIC_95 = float(np.sqrt(-np.log(0.05)))  # 1.73: 95 % of the angles of two equal normal axes, over their RMS


def coverage(rng: np.random.Generator, *, surfels: int = 400) -> list[dict[str, Any]]:
    """Share of the truth within the 95 % interval of the noise, for R_d (true normals) and for normals."""
    rows = []
    for lights, cameras in ((32, 6), (60, 8), (150, 16)):
        for noise in (0.01, 0.05):
            for gloss in (0.0, 0.3):
                skin = model_samples(rng, surfels=surfels, lights=lights, cameras=cameras, noise=noise, gloss=gloss)
                turned = estimate_normals(skin.lumitexels, eta=ETA, scan_error=SCAN_ERROR)
                cosine = (turned["shading_normal"].values * skin.normal).sum(1).clip(-1, 1)
                inside = np.degrees(np.arccos(cosine)) < ISOTROPIC_95 * turned["normal_error"].values
                known = skin.with_normals
                found = estimate_diffuse_reflectance(known, eta=ETA)
                z = (found["diffuse_reflectance"].values - skin.diffuse) / found["diffuse_reflectance_error"].values
                dome = {"lights": lights, "cameras": cameras, "noise": noise, "gloss": gloss}
                rows.append(dome | {"albedo": float((np.abs(z) < 1.96).mean()), "normal": float(inside.mean())})
    return rows


def main() -> None:
    print(json.dumps({"coverage": coverage(np.random.default_rng(11))}, indent=1))


if __name__ == "__main__":
    main()

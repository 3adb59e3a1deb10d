"""Render an exported face in Mitsuba 3, for benchmarks/exports.py, which calls this
program with the Python of Mitsuba.

python benchmarks/programs/exports_mitsuba.py JOBS.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mitsuba
import numpy as np

mitsuba.set_variant("llvm_ad_rgb")


def main() -> None:
    """Render all jobs of a file with the BSDF of the bundle."""
    jobs = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    sys.path.append(str(Path(jobs[0]["maps"]).parent / "mitsuba"))
    import skin

    for job in jobs:
        camera, (width, height) = job["camera"], job["size"]
        K = np.array(camera["K"])
        R = np.array(camera["R"])
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = (
            R.T @ np.diag([-1.0, -1.0, 1.0]),
            camera["centre"],
        )
        sensor = {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(width / 2 / K[0, 0]))),
            "fov_axis": "x",
            "principal_point_offset_x": float((width / 2 - K[0, 2]) / width),
            "principal_point_offset_y": float((height / 2 - K[1, 2]) / height),
            "to_world": mitsuba.ScalarTransform4f(to_world),
            "near_clip": 1.0,
            "far_clip": 1e5,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "rfilter": {"type": "box"},
            },
        }
        lamp = {
            "type": "point",
            "position": job["light"]["position"],
            "intensity": {"type": "rgb", "value": job["light"]["intensity"]},
        }
        scene = {
            "type": "scene",
            "integrator": {"type": "direct"},
            "face": skin.face(),
            "sensor": sensor,
            "lamp": lamp,
        }
        mitsuba.util.write_bitmap(
            job["out"], mitsuba.render(mitsuba.load_dict(scene), spp=job["samples"])
        )


if __name__ == "__main__":
    main()

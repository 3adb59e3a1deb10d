"""Distances of suggested landmarks to the true ones, for scans whose landmarks are known.

    python -m benchmarks landmark_suggestions FOLDER...

Each FOLDER has scan.ply and landmarks.json, as a capture has. One Markdown row for each
case: the points that are set, the scan as it is, and turned.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from skindb.geometry.landmarks import MEAN_FACE, mate, suggest_landmarks

SEVEN = (
    "nose_tip",
    "nasion",
    "chin",
    "eye_outer_left",
    "eye_outer_right",
    "forehead_centre",
    "mouth_corner_left",
)
RIGHT = tuple(name for name in MEAN_FACE if not name.endswith("_left"))
CASES = {  # points that are set, and the turn about the vertical in degrees
    "none": ((), 0.0),
    "none, scan turned by 15 degrees": ((), 15.0),
    "seven": (SEVEN, 0.0),
    "seven, scan turned by 60 degrees": (SEVEN, 60.0),
    "middle, right side, and one eye on the left": ((*RIGHT, "eye_outer_left"), 0.0),
}
Scan = tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]


def main(folders: Sequence[Path]) -> None:
    scans = [read(folder) for folder in folders]
    print(
        f"{len(scans)} scans\n\n| points that are set | median [mm] | 95 % | "
        "largest | farthest point |"
    )
    print("|---" * 5 + "|")
    for label, (landmarks, turn) in CASES.items():
        distances = [errors(scan, landmarks, turn) for scan in scans]
        names = sorted(distances[0])
        table = np.array([[distance[name] for name in names] for distance in distances])
        worst = names[int(np.median(table, axis=0).argmax())]
        quantiles = " | ".join(
            f"{value:.1f}" for value in np.quantile(table, (0.5, 0.95, 1.0))
        )
        print(f"| {label} | {quantiles} | {worst} |", flush=True)


def read(folder: Path) -> Scan:
    mesh = trimesh.load(folder / "scan.ply", process=False)
    points = json.loads((folder / "landmarks.json").read_text())
    return (
        np.asarray(mesh.vertices),
        np.asarray(mesh.faces),
        {name: np.array(points[name]) for name in MEAN_FACE},
    )


def errors(scan: Scan, landmarks: tuple[str, ...], turn: float) -> dict[str, float]:
    """Distances in mm by name; where one side is set, of the mirrored points alone."""
    vertices, faces, points = scan
    matrix = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    turned = {name: matrix @ place for name, place in points.items()}
    suggested = suggest_landmarks(
        vertices @ matrix.T, faces, {name: turned[name] for name in landmarks}
    )
    mirrored = {
        name for name in suggested if mate(name) in landmarks and mate(name) != name
    }
    compared = mirrored if set(RIGHT) <= set(landmarks) else set(suggested)
    return {
        name: float(np.linalg.norm(suggested[name] - turned[name])) for name in compared
    }

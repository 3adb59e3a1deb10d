import hashlib
import json
from dataclasses import replace

import imagecodecs
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from skindb.errors import InputError
from skindb.render import shading
from skindb.render.shading import exitances
from skindb.virtual import dome as virtual_dome
from skindb.virtual.capture import simulate_take
from skindb.virtual.dome import Dome, Sensor, build_dome, frontal_camera
from skindb.virtual.face import field
from skindb.virtual.person import Person, face_shape

PERSON = Person("T001", 30, "female", "european", 5)
DOME = build_dome(4, 3, width=64, height=80, rng=np.random.default_rng(1))


def _simulate(out, **options):
    person = options.pop("person", PERSON)
    seed = options.pop("seed", 7)
    dome = options.pop("dome", DOME)
    simulate_take(
        out, person, dome, rng=np.random.default_rng(seed), spacing_mm=4.0, **options
    )
    return out


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return _simulate(
        tmp_path_factory.mktemp("virtual") / "T001", sensor=Sensor(noisy=False)
    )


def _read(folder, template, **keys):
    return imagecodecs.imread(folder / template.format(**keys))


def _digest(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return [
        (str(p.relative_to(folder)), hashlib.sha256(p.read_bytes()).hexdigest())
        for p in files
    ]


@pytest.mark.slow
def test_simulate_take__writes_every_file_the_format_promises(capture):
    record = json.loads((capture / "capture.json").read_text())
    assert (record["format"], record["version"], record["subject"]) == (
        "skindb-capture",
        1,
        "T001",
    )
    assert record["consent"]["scope"] == ["fit", "statistics", "export", "publish"]
    assert {"age", "gender", "ancestry"} <= record["traits"].keys()
    for key in ("mesh", "landmarks", "regions", "dome", "contact"):
        assert (capture / record[key]).is_file()
    dome = json.loads((capture / record["dome"]).read_text())
    assert (len(dome["cameras"]), len(dome["lights"]), len(dome["exposures"])) == (
        3,
        4,
        2,
    )
    for camera in dome["cameras"]:
        for exposure in dome["exposures"]:
            keys = {"camera": camera["id"], "exposure": exposure["id"]}
            assert _read(capture, dome["dark"], **keys).shape == (80, 64, 3)
            for light in dome["lights"]:
                frame = _read(capture, dome["frames"], light=light["id"], **keys)
                assert (frame.dtype, frame.shape) == (np.uint16, (80, 64, 3))
                white = capture / dome["white"]["frames"].format(
                    light=light["id"], **keys
                )
                assert white.is_file() == (camera["id"] in dome["white"]["cameras"])
    assert all(light["intensity"] is None for light in dome["lights"])
    assert len(dome["sequence"]) == 8


def test_simulate_take__scan_landmarks_and_regions_fit_the_true_surface(capture):
    scan = trimesh.load(capture / "scan.ply", process=False)
    distance = field(np.asarray(scan.vertices), face_shape(PERSON))
    assert 0.03 < distance.std() < 0.25  # mm: the scanner's noise
    marks = json.loads((capture / "landmarks.json").read_text())
    assert len(marks) == 20
    regions = json.loads((capture / "regions.json").read_text())
    assert {
        "forehead",
        "nose",
        "cheek",
        "lips",
        "chin",
        "neck",
        "beard",
    } == regions.keys()
    for (ids,) in regions.values():
        assert max(ids) < len(scan.vertices)
    nose = scan.vertices[regions["nose"][0]]
    assert cKDTree(nose).query(marks["nose_tip"])[0] < 12  # this scan is very coarse


def test_simulate_take__white_frames_give_the_true_intensities(capture):
    dome = json.loads((capture / "dome" / "dome.json").read_text())
    with np.load(str(capture) + ".truth.npz") as truth:
        true = truth["light_intensity"]
    white = dome["white"]
    camera = frontal_camera(DOME)
    centre = camera.R @ np.array(white["point"]) + camera.t
    x, y = np.floor((camera.K @ centre)[:2] / centre[2]).astype(int)
    for light, expected in zip(dome["lights"], true, strict=True):
        frame = _read(
            capture,
            white["frames"],
            exposure="e1",
            light=light["id"],
            camera=camera.name,
        )[y, x]
        levels = dome["cameras"][0]
        radiance = (
            (frame - levels["black_level"])
            / (levels["white_level"] - levels["black_level"])
            / 0.005
        )
        towards = np.array(light["position"]) - white["point"]
        square = towards @ towards
        found = (
            np.pi
            * radiance
            * square
            / (white["reflectance"] * towards[2] / np.sqrt(square))
        )
        # the pixel is not exactly the point: lens, half a pixel; one step of the 12-bit converter
        np.testing.assert_allclose(found, expected, rtol=0.02)


def test_simulate_take__frames_hold_a_lit_face_on_black(capture):
    frame = _read(
        capture,
        "dome/frames/{exposure}/{light}_{camera}.png",
        exposure="e0",
        light="l000",
        camera="c00",
    )
    signal = frame.astype(int) - Sensor().black
    assert (signal[0, :3] == 0).all()
    face = signal[signal[..., 1] > 500]
    assert 0.2 < len(face) / signal[..., 0].size < 0.8
    assert (face[:, 0] >= face[:, 2]).mean() > 0.9  # skin reflects more red than blue


def test_simulate_take__exposures_and_vignetting_follow_the_format(tmp_path, capture):
    bare = replace(
        DOME, cameras=tuple(replace(c, vignette=np.zeros(3)) for c in DOME.cameras)
    )
    plain = tmp_path / "plain"
    simulate_take(
        plain,
        PERSON,
        bare,
        rng=np.random.default_rng(7),
        spacing_mm=4.0,
        sensor=Sensor(noisy=False, step=1),
    )
    camera = DOME.cameras[0]
    sensor = Sensor()
    name = "dome/frames/{exposure}/l000_c00.png"
    long, short = (
        (_read(folder, name, exposure=e).astype(float) - sensor.black)
        for folder, e in ((plain, "e0"), (plain, "e1"))
    )
    used = (short > 500) & (long < 0.95 * (sensor.white - sensor.black))
    assert used.sum() > 500
    # 40 ms against 5 ms; rounding of 500
    np.testing.assert_allclose(long[used] / short[used], 8, rtol=2e-3)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    r2 = (x - camera.K[0, 2]) ** 2 + (y - camera.K[1, 2]) ** 2
    r2 /= (camera.width**2 + camera.height**2) / 4
    expected = (
        long * (1 + camera.vignette[0] * r2 + camera.vignette[1] * r2**2)[..., None]
    )
    shaded = _read(capture, name, exposure="e0").astype(float) - sensor.black
    # half a step of the 12-bit converter, and of this one
    np.testing.assert_allclose(shaded[used], expected[used], atol=9)


def test_simulate_take__truth_lies_beside_the_folder_and_is_consistent(capture):
    with np.load(str(capture) + ".truth.npz") as truth:
        n = len(truth["vertices"])
        for name in ("normals", "diffuse_reflectance", "sigma_tr"):
            assert truth[name].shape == (n, 3)
        assert truth["surface_weights"].shape == (n, len(truth["surface_names"]))
        np.testing.assert_allclose(
            np.linalg.norm(truth["normals"], axis=1), 1, atol=1e-9
        )
        assert truth["site_sigma_tr"].shape == (len(truth["site_names"]), 3)
    assert not list(capture.rglob("*truth*"))


@pytest.mark.slow
def test_simulate_take__same_seed_same_bytes_other_seed_other_noise(tmp_path):
    first, again, other = (
        _simulate(tmp_path / f"t{i}", seed=s) for i, s in enumerate((1, 1, 2))
    )
    assert _digest(first) == _digest(again)
    differing = [
        a[0]
        for a, b in zip(_digest(first), _digest(other), strict=True)
        if a[1] != b[1]
    ]
    assert "dome/frames/e0/l000_c00.png" in differing
    assert "dome/dome.json" not in differing  # one device


def test_simulate_take__lotion_changes_the_highlights_and_not_the_shape(
    tmp_path, capture
):
    lotion = _simulate(
        tmp_path / "lotion",
        person=replace(PERSON, condition="lotion"),
        sensor=Sensor(noisy=False),
    )
    with (
        np.load(str(capture) + ".truth.npz") as a,
        np.load(str(lotion) + ".truth.npz") as b,
    ):
        np.testing.assert_array_equal(a["vertices"], b["vertices"])
        assert (
            b["surface_weights"].sum(axis=1) != a["surface_weights"].sum(axis=1)
        ).all()
    assert json.loads((lotion / "capture.json").read_text())["condition"] == "lotion"


def test_simulate_take__refuses_a_folder_that_is_not_empty(tmp_path):
    (tmp_path / "kept.txt").write_text("keep")
    with pytest.raises(InputError, match="absent or empty"):
        _simulate(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["kept.txt"]


def test_simulate_take__reports_its_progress(tmp_path):
    seen = []
    _simulate(tmp_path / "T", progress=lambda *step: seen.append(step))
    assert [done for _, done, _ in seen] == list(range(1, len(seen) + 1))
    assert seen[-1][1] == seen[-1][2] == 6


def test_simulate_take__computes_subsurface_light_once_for_all_cameras(
    tmp_path, capture, monkeypatch
):
    walks = []

    def counted(surface, lights, scene):
        walks.append(len(lights))
        return exitances(surface, lights, scene)

    for module in (shading, virtual_dome):
        monkeypatch.setattr(module, "exitances", counted)
    soft = _simulate(tmp_path / "soft", subsurface=True, sensor=Sensor(noisy=False))
    assert walks == [4]
    for light in ("l000", "l001", "l002", "l003"):
        name = f"dome/frames/e1/{light}_c00.png"
        spread, local = (
            _read(folder, name).astype(float) - Sensor().black
            for folder in (soft, capture)
        )
        # the scatter keeps most of the power and moves it: into shadows, furthest in red
        np.testing.assert_allclose(
            spread.sum(axis=(0, 1)), local.sum(axis=(0, 1)), rtol=0.1
        )
        assert (spread != local).any()
        dark = (local.max(axis=-1) <= 0) & (spread[..., 0] > 0)
        assert spread[dark, 0].sum() >= spread[dark, 2].sum()
    with np.load(str(soft) + ".truth.npz") as truth:
        assert truth["subsurface"]


@pytest.mark.slow
def test_simulate_take__polarisers_split_highlights_between_cameras(tmp_path, capture):
    """Rationale: both states of a camera together are the camera without polariser, and
    highlights are white and only in one of them.
    """
    left = replace(DOME.lights[0], polariser="left")
    states = {}
    for hand in ("left", "right"):
        cameras = tuple(replace(camera, polariser=hand) for camera in DOME.cameras)
        dome = Dome(cameras, (left, *DOME.lights[1:]))
        states[hand] = _simulate(tmp_path / hand, dome=dome, sensor=Sensor(noisy=False))
    record = json.loads((states["left"] / "dome" / "dome.json").read_text())
    assert (
        record["lights"][0]["polariser"] == record["cameras"][2]["polariser"] == "left"
    )
    assert "polariser" not in record["lights"][1]
    plain, crossed, parallel = (
        _read(folder, "dome/frames/e1/l000_c00.png").astype(float) - Sensor().black
        for folder in (capture, states["left"], states["right"])
    )
    usable = (parallel < Sensor().white - Sensor().black).all(axis=-1)
    error = (crossed + parallel)[usable] / 2 - plain[usable]
    assert np.abs(error).max() <= Sensor().step
    gloss = (parallel - crossed)[usable] / left.intensity * left.intensity.mean()
    assert gloss.max() > 40 * Sensor().step
    assert np.abs(gloss - gloss.mean(axis=1, keepdims=True)).max() <= 2 * Sensor().step
    unpolarised = "dome/frames/e1/l001_c00.png"
    assert (_read(states["left"], unpolarised) == _read(capture, unpolarised)).all()

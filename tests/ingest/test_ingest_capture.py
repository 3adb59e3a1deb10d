from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from sphere import ALBEDO, CAMERAS, INTENSITY, LIGHTS, PROBE_R, RADIUS, face_radiance

from skindb.errors import InputError
from skindb.ingest import read_capture
from skindb.ingest.capture import threads
from skindb.ingest.groups import photograph_group
from skindb.schema import GROUPS, check
from skindb.store import Database
from skindb.workflow import ingest_take


@pytest.fixture(scope="module")
def database(pristine, tmp_path_factory):
    db = Database(tmp_path_factory.mktemp("db") / "faces")
    seen = []
    ingest_take(
        db,
        pristine,
        spacing_mm=4.0,
        photographs=2,
        progress=lambda *step: seen.append(step),
    )
    assert seen[0][0] == "check"
    assert seen[-1][0] == "write"
    return db


@pytest.fixture(scope="module")
def take(database):
    return database.read("capture", "T001")


# what a capture of version 1 cannot say, and what one without polarisers and with a white
# target does not
ABSENT = (
    "fibre_azimuth",
    "site_isotropy_p_value",
    "light_polarisation",
    "camera_polarisation",
    "relative_reflectance",
    "light_gain_applied",
    "light_offset_applied",
    "camera_gain_applied",
    "lobe_strength_applied",
)


def test_ingest_capture__writes_every_variable_of_the_schema(take):
    for group in (
        "samples",
        "surfels",
        "mesh",
        "atlas",
        "dome",
        "probe",
        "photographs",
    ):
        check(
            take[group].to_dataset(),
            [v.name for v in GROUPS[group] if v.name not in ABSENT],
            where=group,
        )


def test_ingest_capture__samples_of_a_lambertian_sphere(take):
    """Rationale: rho = albedo / pi cos(theta_i) by hand. Expected: noise of a pixel, no bias."""
    samples = take["samples"]["reflectance_sample"].values.astype(np.float64)
    place = take["surfels"]["surfel_position"].values.astype(np.float64)
    # the true sphere, not the chords of the scan
    place *= RADIUS / np.linalg.norm(place, axis=1, keepdims=True)
    to_light = take["dome"]["light_position"].values - place[:, None]
    cosine = (
        (to_light * place[:, None]).sum(-1) / RADIUS / np.linalg.norm(to_light, axis=-1)
    )
    truth = (cosine[..., None] * ALBEDO / np.pi)[:, :, None]
    known = np.isfinite(samples).all(-1) & (cosine > 0.3)[..., None]
    assert known.sum() > 1000
    error = (samples / truth - 1)[known]
    assert abs(np.median(error)) < 0.003
    assert np.median(np.abs(error)) < 0.01
    assert np.quantile(np.abs(error), 0.99) < 0.06


def test_ingest_capture__no_sample_where_light_or_camera_do_not_reach(take):
    samples = take["samples"]["reflectance_sample"].values
    known = np.isfinite(samples).all(-1)
    lit = take["surfels"]["light_visible_fraction"].values >= 0.999
    seen = take["surfels"]["camera_visible_fraction"].values == 1
    assert not (known & ~(lit[:, :, None] & seen[:, None])).any()
    np.testing.assert_array_equal(
        take["samples"]["sample_count"].values, known.sum((1, 2))
    )


def test_ingest_capture__intensity_from_the_white_target(take):
    np.testing.assert_allclose(
        take["dome"]["light_intensity"].values, np.tile(INTENSITY, (4, 1)), rtol=2e-3
    )


def test_ingest_capture__probe(take):
    probe = take["probe"].to_dataset()
    assert probe["gain_known"] == 1
    z = (probe["fibre_profile"].values - PROBE_R) / probe["fibre_profile_error"].values
    assert np.abs(z).max() < 4.5  # 36 values
    relative = probe["fibre_profile_error"].values[:, 0] / PROBE_R[0]
    assert (relative < 0.01).all()
    # that of the gains, where the file does not say
    assert (relative >= 0.005 * 0.98).all()
    x, y, z = probe["site_position"].sel(site="cheek").values
    assert (x, y) == pytest.approx((40, 0), abs=6)
    forehead = probe["site_position"].sel(site="forehead").values
    # sag of the scan's chords
    np.testing.assert_allclose(forehead, [0, 56, RADIUS * np.sqrt(0.51)], atol=0.13)
    np.testing.assert_array_equal(
        forehead, take["mesh"]["landmark_position"].sel(landmark="forehead_centre")
    )
    assert np.isnan(probe["site_position"].sel(site="neck").values).all()


def test_ingest_capture__surfels_lie_in_order_with_areas_regions_and_faces(take):
    surfels = take["surfels"].to_dataset()
    mesh = take["mesh"]["triangle"].values
    place = surfels["surfel_position"].values
    np.testing.assert_allclose(np.linalg.norm(place, axis=1), RADIUS, rtol=0.01)
    assert float(surfels["surfel_area"].sum()) == pytest.approx(
        2 * np.pi * RADIUS**2, rel=0.05
    )
    outwards = (surfels["surfel_normal"].values * place).sum(1) / np.linalg.norm(
        place, axis=1
    )
    assert np.median(outwards) > 0.999
    edge = np.linalg.norm(place[mesh[:, 0]] - place[mesh[:, 1]], axis=1)
    assert edge.max() < 10
    nose = surfels["region_mask"].sel(region="nose").values.astype(bool)
    assert np.hypot(*place[nose, :2].T).max() < 14
    assert (surfels["surfel_uv"].values >= 0).all()
    assert (surfels["surfel_uv"].values <= 1).all()


def test_ingest_capture__the_atlas_as_stored_has_no_flips_and_its_distortion_is_told(
    take,
):
    atlas = take["atlas"].to_dataset()
    triangle = take["mesh"]["triangle"].values
    uv = take["surfels"]["surfel_uv"].values
    assert uv.dtype == np.float32
    (ax, ay), (bx, by), (cx, cy) = (
        uv[triangle[:, k]].astype(float).T for k in range(3)
    )
    area = ((by - ay) * (cx - ax) - (bx - ax) * (cy - ay)) / 2
    assert (area > 0).all()
    assert (atlas["atlas_flips"] == 0).all()
    assert atlas["region"].values.tolist() == ["all", *take["surfels"]["region"].values]
    place = take["surfels"]["surfel_position"].values[triangle]
    scanned = (
        np.linalg.norm(
            np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]), axis=1
        )
        / 2
    )
    spread = np.sqrt(np.cov(np.log2(area / scanned), aweights=scanned, ddof=0))
    np.testing.assert_allclose(
        atlas["atlas_area_log2_sd"].sel(region="all"), spread, rtol=1e-4
    )
    assert spread < 0.2
    assert (
        1
        < atlas["atlas_anisotropy_median"].sel(region="all")
        < atlas["atlas_anisotropy_p99"].sel(region="all")
        < 4
    )


def test_ingest_capture__photographs_are_radiance_as_taken(take):
    photos = take["photographs"].to_dataset()
    assert photos.sizes["photograph"] == 2
    assert set(photos["photograph_camera"].values) == {0}
    image = photos["photograph_radiance"][0].values
    light = list(LIGHTS)[int(photos["photograph_light"][0])]
    truth = face_radiance(CAMERAS["c0"], LIGHTS[light])
    lit = truth.min(-1) > 0.2
    # exposures of a camera by hand
    assert abs(np.median(image[lit] / truth[lit]) - 1) < 0.002


@pytest.mark.parametrize("unit", [1.0, 1e-7, 1e6])
def test_photograph_group__keeps_radiance_in_any_unit(unit):
    """The unit of radiance is the capture's own: stored with the precision of single
    floats, whatever it is.
    """
    rng = np.random.default_rng(3)
    first, second = (
        np.float32(unit) * rng.uniform(0, 1, size).astype(np.float32)
        for size in ((4, 5, 3), (6, 3, 3))
    )
    first[0, 0] = np.nan
    group = photograph_group({(1, 0): second, (0, 1): first})
    stored = group["photograph_radiance"].values
    assert stored.dtype == np.float32
    np.testing.assert_array_equal(stored[0, :4, :5], first)
    np.testing.assert_array_equal(stored[1, :6, :3], second)
    assert np.isnan(stored[0, 4:]).all()
    assert np.isnan(stored[1, :, 3:]).all()
    assert group["photograph_light"].values.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("cores", "megapixels", "expected"),
    [
        (None, 1, 2),
        (1, 1, 2),
        (6, 1, 6),
        (64, 1, 8),
        (64, 12, 8),
        (64, 24, 5),
        (64, 150, 2),
    ],
)
def test_threads__are_as_many_as_cores_and_memory_allow(
    pristine, monkeypatch, cores, megapixels, expected
):
    monkeypatch.setattr("skindb.elementwise.cpu_count", lambda: cores)
    dome = read_capture(pristine).dome
    cameras = [
        *dome.cameras[:-1],
        replace(dome.cameras[-1], width=1000, height=1000 * megapixels),
    ]
    assert threads(replace(dome, cameras=cameras)) == expected
    assert threads(None) == 2


@pytest.mark.slow
def test_ingest_capture__numbers_do_not_depend_on_the_threads(
    pristine, take, tmp_path, monkeypatch
):
    monkeypatch.setattr("skindb.elementwise.cpu_count", lambda: 7)
    assert threads(read_capture(pristine).dome) == 7
    db = Database(tmp_path / "db")
    ingest_take(db, pristine, spacing_mm=4.0, photographs=2)
    for group in ("samples", "surfels", "dome", "photographs"):
        for name, values in db.read("capture", "T001")[group].data_vars.items():
            np.testing.assert_array_equal(
                values.values, take[group][name].values, err_msg=name
            )


def test_ingest_capture__provenance(take):
    attrs = take.attrs
    assert attrs["subject"] == "T001"
    assert attrs["consent_scope"] == ["fit", "statistics"]
    assert attrs["traits"] == {"age": 30, "gender": "male"}
    assert attrs["parameters"] == {
        "spacing_mm": 4.0,
        "photographs": 2,
        "calibration": "refuse",
        "refine": "auto",
    }
    assert {
        "capture.json",
        "dome/dome.json",
        "contact/probe.json",
        "scan.ply",
        "frames",
    } <= set(attrs["inputs"])
    assert all(len(digest) == 64 for digest in attrs["inputs"].values())
    assert attrs["frame_count"] == 16 + 8 + 9
    assert attrs["cleaning"]["degenerate_faces"] == 0
    # nothing to repair: the middle of the rim, at z = 0 or below
    ((outline,),) = attrs["cleaning_places"].values()
    np.testing.assert_allclose(outline, [0, 0, -2.5], atol=2.5)
    assert 0 < take["samples/noise_floor"] < 1e-2


def test_ingest_capture__needs_consent_to_fit(capture_folder, tmp_path):
    record = json.loads((capture_folder / "capture.json").read_text())
    record["consent"]["scope"] = ["publish"]
    (capture_folder / "capture.json").write_text(json.dumps(record))
    with pytest.raises(
        InputError,
        match=r"\[consent\]\[scope\]: ingest needs the scope 'fit'; found publish",
    ):
        ingest_take(Database(tmp_path / "db"), capture_folder)


def test_ingest_capture__collects_damage_found_while_decoding_and_writes_nothing(
    capture_folder, tmp_path
):
    """Headers and ends of these files are whole; only decoding shows the damage."""
    broken = [
        "dome/frames/long/l1_c0.png",
        "dome/frames/short/l2_c1.png",
        "dome/white/long/l3_c0.png",
    ]
    broken.append("contact/cheek/b1.png")
    for name in broken:
        content = bytearray((capture_folder / name).read_bytes())
        content[60:200] = bytes(140)
        (capture_folder / name).write_bytes(content)
    db = Database(tmp_path / "db")
    with pytest.raises(InputError) as caught:
        ingest_take(db, capture_folder, spacing_mm=8.0)
    found = "\n".join(map(str, caught.value.faults))
    assert [name for name in broken if name not in found] == []
    assert db.takes() == []


def test_ingest_capture__without_dome_and_probe_keeps_the_surface(
    capture_folder, tmp_path
):
    record = json.loads((capture_folder / "capture.json").read_text())
    for key in ("dome", "contact", "landmarks"):
        del record[key]
    (capture_folder / "capture.json").write_text(json.dumps(record))
    db = Database(tmp_path / "db")
    assert (
        len(ingest_take(db, capture_folder, spacing_mm=8.0).provenance["skipped"]) == 3
    )
    take = db.read("capture", "T001")
    assert set(take.children) == {"surfels", "mesh", "atlas"}
    assert take["surfels"].sizes["surfel"] > 100

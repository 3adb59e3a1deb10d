from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import xarray as xr
from permissions import open_to_others, open_umask
from scipy.interpolate import RegularGridInterpolator

from skindb.errors import InputError
from skindb.export.bundle import export_bundle, merl_table
from skindb.export.gltf import export_gltf
from skindb.export.inputs import texture_size
from skindb.optics.angles import half_difference
from skindb.reflectance.brdf_files import read_dictionary, read_merl
from skindb.reflectance.dictionary import sample_pairs, weighted_error
from skindb.reflectance.tables import lookup
from skindb.render.image import read_exr

SIZE = 64


@pytest.mark.slow
def test_export_bundle__every_file_is_listed_with_its_hash(bundle: Path) -> None:
    manifest = json.loads((bundle / "manifest.json").read_text(encoding="utf-8"))
    there = {str(p.relative_to(bundle)) for p in bundle.rglob("*") if p.is_file()} - {
        "manifest.json"
    }
    there -= {"README.txt"}  # made from the manifest
    assert there == set(manifest["files"])
    for name, about in manifest["files"].items():
        assert (
            hashlib.sha256((bundle / name).read_bytes()).hexdigest() == about["sha256"]
        )
        assert about["holds"]
        assert about["units"]
    assert not list(bundle.parent.glob(".*"))


@pytest.mark.slow
def test_export_bundle__belongs_to_its_owner_alone(
    model: xr.DataTree, tmp_path: Path
) -> None:
    with open_umask():
        export_bundle(model, tmp_path / "new/bundle", size=32)
        export_gltf(model, tmp_path / "face.glb", size=32)
    assert {path.name for path in (tmp_path / "new/bundle").iterdir()} > {
        "maps",
        "bases",
        "usd",
        "mitsuba",
    }
    assert open_to_others(tmp_path, itself=False) == {}


@pytest.mark.slow
def test_export_bundle__its_read_me_names_every_file_and_error(
    merl_bundle: Path,
) -> None:
    text = (merl_bundle / "README.txt").read_text(encoding="utf-8")
    manifest = json.loads((merl_bundle / "manifest.json").read_text(encoding="utf-8"))
    for name in manifest["files"]:
        assert f"- {name}: " in text
    for word in (
        "Blender",
        "Mitsuba",
        "Unreal",
        "MERL",
        "mm in maps",
        "Rec. 709",
        "+x to the subject's left",
    ):
        assert word in " ".join(text.split())
    error = manifest["files"]["model.glb"]["approximation_error"]
    assert f"{error['relative_rms']:.1%}" in text
    assert max(map(len, text.splitlines())) <= 100
    header = OpenEXR.File(str(merl_bundle / "maps/albedo.exr")).header()
    assert header["frame"] == manifest["conventions"]["frame"]
    assert header["colour"].startswith("scene-linear RGB")


def test_texture_size__follows_the_spacing_of_the_surfels(model: xr.DataTree) -> None:
    """24 surfels on 0.9 of the width: 1.5 texels for each are 39, and the next power of
    two is 64.
    """
    assert texture_size(model) == 64
    fitted = model["fitted"].to_dataset()
    model["fitted/surfel_uv"].values[:] = fitted["surfel_uv"].values / 4
    assert texture_size(model) == 256


def test_export_bundle__maps_and_tables_come_back(
    model: xr.DataTree, bundle: Path
) -> None:
    assert "MERL binaries" not in (bundle / "README.txt").read_text(encoding="utf-8")
    albedo, names = read_exr(bundle / "maps/albedo.exr")
    assert names == ("R", "G", "B")
    row = column = SIZE // 4
    np.testing.assert_allclose(
        albedo[row, column, 0], 0.2 + 0.5 * (column + 0.5) / SIZE, atol=2e-6
    )
    assert read_exr(bundle / "maps/weight_1.exr")[0].shape == (SIZE, SIZE, 1)
    with np.load(bundle / "bases/bases.npz") as stored:
        np.testing.assert_array_equal(
            stored["basis_brdf"], model["basis/basis_brdf"][..., :-1]
        )
        assert list(stored["dictionary_names"]) == ["a", "b"]
        assert stored["theta_h"][-1] == pytest.approx(np.pi / 2)


@pytest.mark.slow
def test_export_bundle__its_bases_can_be_fitted_with(
    model: xr.DataTree, tables: np.ndarray, tmp_path: Path
) -> None:
    """Other nodes than the dictionary's: resampling is the error; the MERL files beside
    know no disc.
    """
    model["basis/disc_angular_radius"].values[...] = 0.014
    folder = export_bundle(model, tmp_path / "out", size=SIZE, merl=True).parent
    back = read_dictionary(folder / "bases")
    assert back.names == ("component0", "component1")
    assert back.disc_angular_radius == 0.014
    assert max(origin.resampling_error for origin in back.origins) < 0.01
    wi, wo = sample_pairs()
    above = np.minimum(wi[:, 2], wo[:, 2]) > 0.3
    wi, wo = wi[above], wo[above]
    angles = half_difference(wi, wo)
    assert (
        weighted_error(
            lookup(back.table, *angles), lookup(tables, *angles), wi, wo
        ).max()
        < 0.01
    )


def test_export_bundle__merl_files_hold_the_lobes(
    merl_bundle: Path, tables: np.ndarray
) -> None:
    back = read_merl(merl_bundle / "bases/component_1.binary")
    back = back[0] if isinstance(back, tuple) else back
    assert back.shape == (90, 90, 180, 3)
    np.testing.assert_allclose(back, merl_table(tables[..., 1]), rtol=1e-12)


def test_merl_table__reads_the_table_at_bin_centres() -> None:
    table = np.random.default_rng(5).uniform(0.1, 1, (6, 5, 4)).astype(np.float32)
    wrapped = np.concatenate([table, table[..., :1]], axis=2).astype(float)
    # sqrt(theta_h / 90 deg), degrees
    nodes = (np.linspace(0, 1, 6), np.linspace(0, 90, 5), np.linspace(0, 180, 5))
    i, j, k = np.meshgrid([0, 10, 89], [0, 21, 89], [0, 35, 179], indexing="ij")
    centres = np.stack([(i + 0.5) / 90, j + 0.5, k + 0.5], axis=-1)
    expected = RegularGridInterpolator(nodes, wrapped)(centres)
    found = merl_table(table)
    assert found.shape == (90, 90, 180, 3)
    np.testing.assert_allclose(
        found[i, j, k], np.repeat(expected[..., None], 3, axis=-1), rtol=1e-6
    )


def test_export_bundle__says_how_wrong_it_is(bundle: Path) -> None:
    manifest = json.loads((bundle / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["error"]["fit_residual"]["median"] == pytest.approx(0.04)
    assert manifest["error"]["diffuse_reflectance_error"]["units"] == "1"
    shares = {
        name: about["fraction"]
        for name, about in manifest["error"]["status_fraction"].items()
    }
    assert set(shares) == {"fitted", "unseen"}
    assert sum(shares.values()) == pytest.approx(1)
    cheek = manifest["translucency_sites"]["cheek"]
    assert cheek["sigma_tr"] == pytest.approx([0.5, 0.8, None])
    assert cheek["standard_error"] == pytest.approx([0.1, 0.1, None])
    assert cheek["total_error"] == pytest.approx([0.11, 0.12, None])
    assert cheek["status"] == ["fitted", "poor_fit", "too_few_fibres"]
    assert manifest["files"]["model.glb"]["approximation_error"]["relative_rms"] > 0
    assert manifest["missing"] == []
    assert manifest["provenance"]["parameters"] == {"k": 2}
    assert manifest["may_be_published"] is False


def test_export_bundle__states_the_light_disc_of_its_bases(
    model: xr.DataTree, bundle: Path, tmp_path: Path
) -> None:
    manifest = json.loads((bundle / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["disc_angular_radius"] == 0
    model["basis/disc_angular_radius"].values[...] = 0.014
    manifest = json.loads(
        export_bundle(model, tmp_path / "out", size=SIZE, merl=False).read_text(
            encoding="utf-8"
        )
    )
    assert manifest["disc_angular_radius"] == 0.014
    assert "disc_angular_radius [rad]" in manifest["conventions"]["light_disc"]


@pytest.mark.slow
def test_export_bundle__names_what_is_missing(
    model: xr.DataTree, tmp_path: Path
) -> None:
    model["fitted/sigma_tr"].values[:, 2] = np.nan
    manifest = json.loads(
        export_bundle(model, tmp_path / "out", size=SIZE, merl=False).read_text(
            encoding="utf-8"
        )
    )
    assert manifest["missing"] == [
        "maps/translucency.exr: B: sigma_tr is unknown at all probe sites"
    ]
    assert manifest["files"]["maps/translucency.exr"]["channels"] == ["R", "G"]
    assert read_exr(tmp_path / "out/maps/translucency.exr")[1] == ("R", "G")
    model["fitted"] = model["fitted"].to_dataset().drop_vars("sigma_tr")
    manifest = json.loads(
        export_bundle(model, tmp_path / "no", size=SIZE, merl=False).read_text(
            encoding="utf-8"
        )
    )
    assert manifest["missing"] == [
        "maps/translucency.exr: R, G, B: sigma_tr is unknown at all probe sites"
    ]


def test_export_bundle__says_that_a_model_was_edited(
    model: xr.DataTree, bundle: Path, tmp_path: Path
) -> None:
    assert (
        json.loads((bundle / "manifest.json").read_text(encoding="utf-8"))["edited"]
        is None
    )
    made_from = [
        {"kind": "model", "take": "S01", "generation": 3},
        {"kind": "population", "take": "traits"},
    ]
    model.attrs |= {
        "edit": {"lotion": 0.5},
        "edit_distance": np.inf,
        "inputs": made_from,
        "take": "S01.normal",
    }
    manifest = json.loads(
        export_bundle(model, tmp_path / "out", size=SIZE, merl=False).read_text(
            encoding="utf-8"
        )
    )
    assert manifest["provenance"]["edit"] == {"lotion": 0.5}
    assert manifest["provenance"]["edit_distance"] is None  # JSON has no infinity
    said = manifest["edited"]
    assert (said["from"], said["model_generation"], said["by"]) == (
        "S01.normal",
        3,
        {"lotion": 0.5},
    )
    assert "was not measured" in said["consent"]
    assert not manifest["may_be_published"]  # as the person said
    assert any("did not see the edited face" in line for line in manifest["missing"])
    assert b"was not measured" in (tmp_path / "out/model.glb").read_bytes()
    text = " ".join((tmp_path / "out/README.txt").read_text(encoding="utf-8").split())
    assert "The face was edited by lotion 0.5. This face was not measured." in text


def test_export_bundle__refuses_without_consent_and_over_files(
    model: xr.DataTree, tmp_path: Path
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("keep")
    with pytest.raises(
        InputError, match="must be a new or empty folder; found files in it"
    ):
        export_bundle(model, tmp_path / "full", size=SIZE)
    assert (tmp_path / "full/mine.txt").read_text() == "keep"
    model.attrs["consent_scope"] = []
    with pytest.raises(
        InputError, match="needs the scope 'export'; found no scope at all"
    ):
        export_bundle(model, tmp_path / "out", size=SIZE)
    assert not (tmp_path / "out").exists()


def test_export_bundle__a_failure_leaves_nothing_behind(
    model: xr.DataTree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: object, **kwargs: object) -> None:
        raise OSError("disc full")

    monkeypatch.setattr("skindb.export.bundle.export_gltf", broken)
    with pytest.raises(OSError, match="disc full"):
        export_bundle(model, tmp_path / "out", size=SIZE, merl=False)
    assert list(tmp_path.iterdir()) == []


def test_export_bundle__tells_its_progress(model: xr.DataTree, tmp_path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    export_bundle(
        model,
        tmp_path / "out",
        size=SIZE,
        merl=False,
        progress=lambda *call: calls.append(call),
    )
    assert [done for _, done, _ in calls] == [0, 1, 2, 3]

"""The USD scene and the MaterialX file, read by their own libraries (`pip install
usd-core materialx`).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from skindb.export.bundle import export_bundle
from skindb.export.inputs import mean_free_path
from skindb.export.scenes import index_of
from skindb.export.textures import fit_material
from skindb.reflectance.tables import kernel_tables
from skindb.render.image import read_exr

SIZE = 64


def test_export_usd__files_name_only_files_that_are_there(bundle: Path) -> None:
    for name in ("face.usda", "face.mtlx"):
        text = (bundle / "usd" / name).read_text(encoding="utf-8")
        named = {
            part
            for part in text.replace("@", '"').split('"')
            if part.endswith((".png", ".exr"))
        }
        assert {
            "baseColor.png",
            "roughness.png",
            "normal.png",
            "../maps/mean_free_path.exr",
        } <= named
        for file in named:
            assert (bundle / "usd" / file).resolve().is_file()


def test_export_usd__is_a_valid_stage(model: xr.DataTree, bundle: Path) -> None:
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    del pxr
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    stage = Usd.Stage.Open(str(bundle / "usd/face.usda"))
    checks = UsdValidation.ValidationContext(
        UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    )
    # the package of PyPI does not know the nodes of MaterialX, which the test below
    # looks up in their own library
    found = [
        one.GetMessage()
        for one in checks.Validate(stage)
        if "shaderId 'ND_" not in one.GetMessage()
    ]
    assert found == []
    assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(1e-3)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Face/Skin"))
    fitted = model["fitted"].to_dataset()
    np.testing.assert_allclose(
        np.array(mesh.GetPointsAttr().Get()), fitted["surfel_position"], atol=1e-4
    )
    np.testing.assert_array_equal(
        np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3),
        model["mesh/triangle"],
    )
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    np.testing.assert_allclose(st * [1, -1] + [0, 1], fitted["surfel_uv"], atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource("mtlx")
    assert surface.GetIdAttr().Get() == "ND_open_pbr_surface_surfaceshader"
    radius = surface.GetInput("subsurface_radius").Get()
    path = read_exr(bundle / "maps/mean_free_path.exr")[0]
    assert radius == pytest.approx(path.max(), rel=1e-5)  # mm
    ratio = surface.GetInput("subsurface_radius_scale").GetConnectedSource()[0]
    # six digits
    assert ratio.GetInput("in2").Get() == pytest.approx(1 / radius, rel=1e-5)
    image = ratio.GetInput("in1").GetConnectedSource()[0]
    assert (
        bundle / "usd" / image.GetInput("file").Get().path
    ).resolve() == bundle / "maps/mean_free_path.exr"
    assert image.GetInput("uaddressmode").Get() == "clamp"
    # inputs of OpenPBR are at most 1; half precision
    assert (path / radius).max() <= 1.001
    diffuse = 0.2 + 0.5 * np.array([20.5 / SIZE, 20.5 / SIZE, 0])
    expected = mean_free_path(diffuse, np.array([0.5, 0.8, 1.25]), eta=1.3)
    # mm; interpolated between surfels
    np.testing.assert_allclose(path[20, 20, :2], expected[:2], rtol=0.01)


def test_export_usd__its_preview_reflects_as_much_as_the_face(
    model: xr.DataTree, bundle: Path
) -> None:
    """UsdPreviewSurface has no factor on the reflection, so that its index must contain
    the mean of this factor.
    """
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdShade

    stage = Usd.Stage.Open(str(bundle / "usd/face.usda"))
    preview, _, _ = UsdShade.Material(
        stage.GetPrimAtPath("/Face/Materials/Skin")
    ).ComputeSurfaceSource()
    assert preview.GetIdAttr().Get() == "UsdPreviewSurface"
    ior = preview.GetInput("ior").Get()
    fitted = (
        model["fitted"].to_dataset().isel(surfel=model["fitted/fit_status"].values == 0)
    )
    tables = kernel_tables(model["basis"].to_dataset())
    diffuse = fitted["diffuse_reflectance"].values
    skin = fit_material(tables, diffuse, fitted["basis_weight"].values, eta=1.3)
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(
        (skin.specular * skin.f0).mean(), rel=1e-3
    )
    colour = preview.GetInput("diffuseColor").GetConnectedSource()[0]
    assert colour.GetInput("wrapS").Get() == colour.GetInput("wrapT").Get() == "clamp"


def test_export_usd__its_material_is_valid_materialx(bundle: Path) -> None:
    mx = pytest.importorskip("MaterialX", reason="materialx is not installed")
    library = mx.createDocument()
    document = mx.createDocument()
    mx.loadLibraries(
        mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library
    )
    mx.readFromXmlFile(document, str(bundle / "usd/face.mtlx"))
    document.setDataLibrary(library)
    valid, message = document.validate()
    assert valid, message
    for name in re.findall(
        r'info:id = "(ND_[A-Za-z0-9_]+)"',
        (bundle / "usd/face.usda").read_text(encoding="utf-8"),
    ):
        assert library.getNodeDef(name) is not None, name
    definition = library.getNodeDef("ND_open_pbr_surface_surfaceshader")
    given = document.getNode("skin_surface").getInputs()
    for one in given:
        assert definition.getInput(one.getName()).getType() == one.getType()
    [material] = document.getMaterialNodes()
    [shader] = mx.getShaderNodes(material)
    assert shader.getCategory() == "open_pbr_surface"


@pytest.mark.parametrize(("f0", "index"), [(0.04, 1.5), (0.0278, 1.4)])
def test_index_of__fresnel_at_normal_incidence(f0: float, index: float) -> None:
    assert index_of(f0) == pytest.approx(index, rel=1e-3)


@pytest.mark.slow
def test_export_usd__without_translucency_light_stays(
    model: xr.DataTree, tmp_path: Path
) -> None:
    model["fitted"] = model["fitted"].to_dataset().drop_vars("sigma_tr")
    text = (
        export_bundle(model, tmp_path / "out", size=SIZE, merl=False).parent
        / "usd/face.usda"
    ).read_text()
    assert "subsurface" not in text

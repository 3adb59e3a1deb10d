"""Colour of skin with errors, and the table with one row for each value."""

from __future__ import annotations

from functools import partial

import colour
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from planted_population import population
from planted_tables import planted_tables

from skindb.analysis import group_effects, tidy
from skindb.analysis.colour import typology_angle, typology_class
from skindb.analysis.quantities import (
    DERIVED,
    QUANTITIES,
    measurements,
)
from skindb.cli import cli
from skindb.errors import InputError
from skindb.store import Database

# R_d of cheeks from dark to very light skin
SKIN = np.array(
    [[0.11, 0.05, 0.03], [0.3, 0.18, 0.12], [0.45, 0.31, 0.24], [0.6, 0.5, 0.45]]
)
ERROR = 0.004
LEVEL = 0.01
DRAWS = 4000


@pytest.fixture
def cohort():
    """Takes of two subjects: three in the condition normal, one under lotion."""
    cohort = planted_tables(
        ["S1", "S1", "S1", "S2"],
        conditions=["normal", "normal", "lotion", "normal"],
        age=[30, 31, 30, 50],
        unit=["a", "a", "a", "b"],
        level_error=LEVEL,
    )
    values = cohort["region_diffuse_reflectance"].copy(
        data=np.stack([SKIN[:, None]] * 2, axis=1)[:, :, 0]
    )
    error = values.copy(data=np.full(values.shape, ERROR))
    return cohort.assign(
        region_diffuse_reflectance=values,
        region_diffuse_reflectance_error=error,
        region_diffuse_reflectance_total_error=np.hypot(error, LEVEL),
    ).assign_coords(take=["S1", "S1.normal.2", "S1.lotion", "S2"])


def face(frame: pd.DataFrame, quantity: str) -> pd.DataFrame:
    return frame[(frame.quantity == quantity) & (frame.region == "face")]


def test_tidy__colours_are_those_of_colour_science(cohort):
    lab = colour.XYZ_to_Lab(
        SKIN @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T,
        colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"],
    )
    frame = tidy(cohort)
    for i, name in enumerate(("L*", "a*", "b*")):
        np.testing.assert_allclose(face(frame, name).value, lab[:, i], rtol=1e-9)
    angle = np.degrees(np.arctan((lab[:, 0] - 50) / lab[:, 2]))
    np.testing.assert_allclose(face(frame, "ITA").value, angle, rtol=1e-9)
    assert [*face(frame, "ITA").label] == [typology_class(one) for one in angle]
    assert typology_class(angle[0]) == "dark (VI)"
    assert typology_class(angle[3]) == "very light (I)"
    absorbance = -100 * np.log10(SKIN)
    np.testing.assert_allclose(face(frame, "melanin index").value, absorbance[:, 0])
    np.testing.assert_allclose(
        face(frame, "erythema index").value, absorbance[:, 1] - absorbance[:, 0]
    )
    difference = colour.delta_E(lab[1:3], lab[[0, 0]], method="CIE 2000")
    rows = face(frame, "delta E")
    np.testing.assert_allclose(rows.value.iloc[1:3], difference, rtol=1e-9)
    assert [*rows.status] == ["baseline", "fitted", "fitted", "baseline"]
    assert rows.value.iloc[[0, 3]].isna().all()


def test_tidy__errors_are_those_of_a_simulation(cohort):
    """Standard deviations of 4,000 draws are known to 1.1 %, and the errors are of first
    order, which 0.004 in R_d of 0.03 makes wrong by 2 %: 6 % are allowed.
    """
    frame = tidy(cohort)
    rng = np.random.default_rng(4)
    noise = ERROR * rng.standard_normal((DRAWS, *SKIN.shape))
    level = LEVEL / 10 * rng.standard_normal((DRAWS, len(SKIN), 1))
    for name, quantity in QUANTITIES.items():
        if quantity.derive is not None:
            rows = face(frame, name)
            drawn = quantity.derive(SKIN + noise).std(axis=0)
            np.testing.assert_allclose(rows.error, drawn, rtol=0.06)
            # a tenth of the level's error, as the first order is too coarse for all of it
            drawn = quantity.derive(SKIN + level).std(axis=0)
            np.testing.assert_allclose(rows.common_error, 10 * drawn, rtol=0.06)
    before = noise[:, [0, 0]] + SKIN[0]
    lab = [
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(x, "sRGB"))
        for x in (SKIN[1:3] + noise[:, 1:3], before)
    ]
    drawn = colour.delta_E(*lab, method="CIE 2000").std(axis=0)
    np.testing.assert_allclose(face(frame, "delta E").error.iloc[1:3], drawn, rtol=0.06)


def test_tidy__reflectance_of_unknown_scale_has_no_colour(cohort):
    relative = ("take", np.array([None, True, None, None], object))
    frame = tidy(cohort.assign_coords(fit_relative_reflectance=relative))
    whole = tidy(cohort)
    own = frame["take"] == "S1.normal.2"
    reflectance = frame.quantity == "R_d"
    assert (frame.status[own & reflectance] == "relative").all()
    same = ~own | frame.quantity.isin(["R_d", "surface reflectance", "sigma_tr"])
    pd.testing.assert_series_equal(frame.value[same], whole.value[same])
    colours = frame[~same]
    assert set(colours.quantity) == {*DERIVED, "delta E"}
    assert colours.value.isna().all()
    assert (colours.label == "").all()


def test_tidy__a_baseline_of_unknown_scale_has_no_difference(cohort):
    relative = ("take", np.array([True, None, None, None], object))
    frame = tidy(cohort.assign_coords(fit_relative_reflectance=relative))
    differences = frame[frame.quantity == "delta E"]
    assert differences.value.isna().all()
    assert differences.error.isna().all()


def test_tidy__columns(cohort):
    frame = tidy(cohort)
    # 2 regions x 3 channels, 2 regions, 1 site x 3 channels, and 7 colours of 2 regions
    assert len(frame) == 4 * (6 + 2 + 3 + 14)
    assert not frame.duplicated(["take", "quantity", "region", "channel"]).any()
    row = frame[(frame["take"] == "S1.normal.2") & (frame.quantity == "R_d")].iloc[4]
    assert (row.subject, row.condition, row.visit, row["repeat"]) == (
        "S1",
        "normal",
        2,
        1,
    )
    assert (row.region, row.channel, row.unit, row.age) == ("beard", "G", "1", 31)
    assert row.attribute_unit == "a"
    assert row.value == SKIN[1, 1]
    assert (row.error, row.common_error) == pytest.approx((ERROR, LEVEL))
    of_take = face(frame, "R_d")[face(frame, "R_d").channel == "R"].set_index("take")
    first = SKIN[0, 0]
    np.testing.assert_array_equal(
        of_take.baseline[["S1", "S1.normal.2", "S1.lotion", "S2"]],
        [np.nan, first, first, np.nan],
    )
    surface = frame[frame.quantity == "surface reflectance"]
    assert surface.error.isna().all()  # none is stated
    units = {name: set(part.unit) for name, part in frame.groupby("quantity")}
    assert units["ITA"] == {"degree"}
    assert units["sigma_tr"] == {"mm-1"}


def test_measurements__what_is_unknown(cohort):
    cohort["region_diffuse_reflectance"][0] = np.nan
    cohort["site_status"][1] = 4
    frame = tidy(cohort).set_index("take")
    of_first = frame.loc["S1"]
    colours = of_first[
        of_first.region.isin(["face", "beard"])
        & (of_first.quantity != "surface reflectance")
    ]
    assert colours.value.isna().all()
    assert set(colours.status) == {"missing", "baseline"}
    probed = frame.loc["S1.normal.2"].query("quantity == 'sigma_tr'")
    assert probed.value.isna().all()
    assert set(probed.status) == {"unidentified"}
    with pytest.raises(
        InputError, match=r"quantity ITE: must be known; .* choose from: R_d,"
    ):
        measurements(cohort, ["ITE"])


def test_tidy__roughness_of_surfels_too_far_apart_is_unknown(cohort):
    """Texture of a take of wide spacing is missing, and says why."""
    along = ("take", "region")
    slope = np.array([[0.1, 0.1]] * 3 + [[np.nan, np.nan]])
    area = np.full((4, 2), 100.0)
    frame = tidy(
        cohort.assign(
            region_normal_slope=(along, slope),
            region_area=(along, area),
            region_surfels=(along, np.array([[50] * 2] * 3 + [[10] * 2])),
        )
    )
    rows = face(frame, "RMS slope")
    far = "surfels too far apart"
    assert rows["status"].tolist() == ["fitted", "fitted", "fitted", far]
    assert rows["value"].notna().tolist() == [True, True, True, False]


def test_group_effects__of_colour():
    """Planted 0.05 in R_d of the second group: its ITA, by colour-science, is between
    the ends of its interval, and no other quantity is compared.
    """
    change = 0.05 * np.repeat([0, 1], 20)
    cohort = planted_tables(
        [f"S{i}" for i in range(40)], albedo=change, gender=["f"] * 20 + ["m"] * 20
    )
    effects = group_effects(
        cohort,
        group_by="gender",
        quantities=["ITA"],
        permutations=200,
        rng=np.random.default_rng(1),
    )
    assert [*effects["quantity"].values] == ["ITA face", "ITA beard"]
    level = np.array([0.5, 0.4, 0.3])
    planted = float(typology_angle(level + 0.05) - typology_angle(level))
    assert (effects["effect_low"] < planted).all()
    assert (planted < effects["effect_high"]).all()
    assert (effects["effect_p"] < 0.05).all()


def test_tidy_command__writes_what_the_function_returns(tmp_path):
    db = Database(tmp_path / "db")
    for take, model in population().items():
        with db.stage("model", take) as stage:
            groups = model.children.items()
            stage.write({name: group.to_dataset() for name, group in groups})
            stage.commit(model.attrs)
    out = tmp_path / "table.csv"
    run = partial(CliRunner().invoke, cli)
    result = run(["tidy", db.url, "--out", str(out)])
    assert result.exit_code == 0, result.output
    written = pd.read_csv(out)
    frame = tidy(db.cohort("tables"))
    assert [*written.columns] == [*frame.columns]
    assert result.output == f"{out}: {len(frame)} rows\n"
    np.testing.assert_allclose(written.value, frame.value, rtol=1e-12)
    assert [*written["take"]] == [*frame["take"]]
    assert db.audit()[0][-1].action == "tidy"
    refused = run(["tidy", db.url, "--out", str(tmp_path / "table.txt")])
    assert refused.exit_code != 0


def test_typology_angle__grey_is_no_skin():
    angle = typology_angle(
        np.array([[0.4, 0.4, 0.4], [0.2, 0.3, 0.5], [0.5, 0.4, 0.3]])
    )
    assert np.isnan(angle[:2]).all()
    assert np.isfinite(angle[2])


def test_tidy__without_regions_and_sites_is_one_line(cohort):
    bare = cohort.drop_vars([name for name in cohort if name.startswith("region_")])
    bare = bare.drop_vars([name for name in bare if name.startswith("site_")])
    with pytest.raises(InputError, match="must have regions or probe sites"):
        tidy(bare)

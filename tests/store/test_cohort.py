"""Cohorts: lazy labelled arrays over takes that equal the values of each take; takes
may lack parts.
"""

from __future__ import annotations

from unittest import mock

import dask
import numpy as np
import pytest
import xarray as xr
from planted_cohort import PEOPLE, database

from skindb import workflow
from skindb.analysis import sample_surfels
from skindb.errors import InputError
from skindb.schema import ProbeStatus
from skindb.schema.cohort import MAX_BLOCK_TAKES, Held, Part, Values, column, combine
from skindb.store import Database
from skindb.store.cohort import Address, _group
from skindb.workflow import cohorts


@pytest.fixture(scope="module")
def db(tmp_path_factory) -> Database:
    return database(tmp_path_factory.mktemp("cohort"), PEOPLE)


@pytest.mark.slow
def test_cohort__tables_are_those_of_every_take(db):
    cohort = db.cohort("tables")
    assert cohort.sizes["take"] == len(PEOPLE) - 1
    assert all(array.chunks is not None for array in cohort.data_vars.values())
    for take in cohort["take"].values:
        own = db.tables(db.record("model", take))
        shown = cohort.sel(take=take)
        for name in own.data_vars:
            found = shown[name].sel(
                {dim: own[dim].values for dim in own[name].dims if dim in own.coords}
            )
            np.testing.assert_array_equal(found.values, own[name].values, err_msg=name)


def test_cohort__what_a_take_lacks_is_missing(db):
    cohort = db.cohort("tables")
    absent = cohort["site_sigma_tr"].sel(take="S02", site="neck")
    assert np.isnan(absent).all()
    assert (
        cohort["site_status"].sel(take="S02", site="neck") == ProbeStatus.NOT_MEASURED
    ).all()
    assert np.isnan(cohort["age"].sel(take="S03"))
    assert cohort["hair"].isnull().sum() == cohort.sizes["take"] - 1


def test_cohort__coordinates_work_as_anywhere_in_xarray(db):
    cohort = db.cohort("tables")
    colour = cohort["region_diffuse_reflectance"].sel(region="face")
    means = colour.groupby("gender").mean()
    women = [
        take
        for take, person in PEOPLE.items()
        if person["traits"].get("gender") == "female"
    ]
    shown = [take for take in women if take in cohort["take"].values]
    np.testing.assert_allclose(
        means.sel(gender="female"), colour.sel(take=shown).mean("take")
    )
    old = cohort.where(cohort.age > 40, drop=True)
    assert old["take"].values.tolist() == ["S02"]
    frame = cohort[["region_area"]].to_dataframe()
    assert frame.loc[("S01", "face"), "gender"] == "female"


def test_cohort__consent(db):
    cohort = db.cohort("tables")
    assert "S04" not in cohort["take"].values
    assert cohort.attrs["skipped"] == [
        {"take": "S04", "reason": "its consent does not cover statistics"}
    ]
    with pytest.raises(InputError, match="statistics need takes that consent to them"):
        db.cohort("tables", takes=["S04"])


def test_cohort__surfels_and_their_samples(db):
    cohort = db.cohort("surfels", surfels=50)
    assert cohort["reflectance_sample"].dims == (
        "take",
        "surfel",
        "light",
        "camera",
        "channel",
    )
    for take in ("S01", "S02"):
        one = cohort.sel(take=take)
        model = db.read("model", take)
        index = one["surfel_index"].values
        assert len(set(index.tolist())) == 50
        fitted = model["fitted"].to_dataset()
        capture = db.source(model)
        for name in ("diffuse_reflectance", "dictionary_weight", "shading_normal"):
            np.testing.assert_array_equal(one[name], fitted[name].isel(surfel=index))
        samples = (
            capture["samples"].to_dataset()["reflectance_sample"].isel(surfel=index)
        )
        np.testing.assert_array_equal(one["reflectance_sample"], samples)
        np.testing.assert_array_equal(
            one["light_position"], capture["dome"].to_dataset()["light_position"]
        )
    # the first of a sample are a smaller sample
    few = db.cohort("surfels", surfels=10, variables=["surfel_index"])
    np.testing.assert_array_equal(
        few["surfel_index"], cohort["surfel_index"].isel(surfel=slice(10))
    )


def test_cohort__a_sample_represents_the_face(db):
    """Means of 200 samples of 60 surfels agree with that of all surfels within 5
    standard errors.
    """
    model = db.read("model", "S01").load()
    values = model["fitted"].to_dataset()["diffuse_reflectance"].values[:, 0]
    good = values[model["fitted"].to_dataset()["fit_status"].values == 0]
    means = [
        float(
            sample_surfels(model, surfels=60, seed=s)["diffuse_reflectance"][
                :, 0
            ].mean()
        )
        for s in range(200)
    ]
    error = good.std(ddof=1) * np.sqrt((1 - 60 / len(good)) / 60)
    assert abs(np.mean(means) - good.mean()) < 5 * error / np.sqrt(200)
    # 200 samples give the deviation to 5 %
    assert np.std(means) == pytest.approx(error, rel=0.25)


@pytest.mark.slow
def test_cohort__samples_of_other_code_are_made_by_summarise(db, monkeypatch):
    assert workflow.summarise(db) == []
    monkeypatch.setattr(cohorts, "summary_digest", lambda: "0" * 64)
    takes = ["S01", "S01.lotion", "S02", "S03", "S04"]
    assert workflow.summarise(db) == takes
    assert workflow.summarise(db) == []


def test_cohort__one_take_of_every_subject(db):
    cohort = db.cohort("tables", dim="subject")
    assert cohort["subject"].values.tolist() == ["S01", "S02", "S03"]
    assert cohort["take"].values.tolist() == ["S01", "S02", "S03"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"layout": "pictures"}, "must be one of tables, surfels, maps"),
        ({"variables": ["nose"]}, "variable nose: a cohort has it"),
        ({"takes": ["nobody"]}, "nobody: every take of a cohort must have a model"),
        ({"dim": "person"}, "must be take or subject"),
        ({"layout": "maps"}, "run skindb register first"),
    ],
)
def test_cohort__mistakes(db, options, said):
    with pytest.raises(InputError, match=said):
        db.cohort(**options)


@pytest.mark.slow
def test_cohort__a_replaced_version_is_not_mistaken_for_the_one_before(
    db, fitted_database
):
    own = fitted_database
    cohort = own.cohort("tables", takes=["S01"])
    (record,) = own.history("model", "S01")
    path = own.root / "log/model/S01/00000001.json"
    path.write_bytes((db.root / "log/model/S01/00000001.json").read_bytes())
    assert own.record("model", "S01", 1).seal != record.seal
    with pytest.raises(
        InputError, match="a version must not change while a cohort refers to it"
    ):
        cohort["region_area"].compute(scheduler="synchronous")


def test_table__one_row_a_take(db):
    table = db.table()
    assert list(table.index) == ["S01", "S01.lotion", "S02", "S03", "S04"]
    assert table.loc["S02", "age"] == 60
    assert table.loc["S01.lotion", "condition"] == "lotion"
    assert table.loc["S04", "consent"] == "fit"
    assert (table["fit_k"] == 2).all()
    assert table["registration_generation"].isna().all()
    assert table.groupby("gender").size()["female"] == 3


def test_cohort__the_cache_of_records_changes_nothing(tmp_path):
    """A cohort of all takes is opened from the cache, and one of few takes without it."""
    db = database(tmp_path, PEOPLE)
    cache = db.root / "catalogue"
    few = db.cohort("surfels", takes=[*PEOPLE]).compute()
    for damage in (None, b"{}", None):
        cached = db.cohort("surfels").compute()
        xr.testing.assert_identical(cached, few)
        if damage is None:
            with mock.patch("skindb.store.log.Log._read", side_effect=AssertionError):
                again = db.cohort("surfels")
            xr.testing.assert_identical(again.compute(), few)
        else:
            for block in cache.iterdir():
                block.write_bytes(damage)


def test_combine__a_thousand_takes_are_opened_without_being_read():
    class Never:
        def read(self, name):
            raise AssertionError(name)

    one = xr.Dataset({"region_area": ("region", np.zeros(3))}, {"region": list("abc")})
    part = Held.part("x", {"subject": "x", "age": 3}, one)
    parts = [
        type(part)(
            f"T{i}", part.coords, part.variables, part.sizes, part.labels, Never()
        )
        for i in range(1000)
    ]
    cohort = combine(parts)
    assert cohort.sizes == {"take": 1000, "region": 3}
    assert len(cohort.__dask_graph__()) == 1 + -(-1000 // MAX_BLOCK_TAKES)
    with pytest.raises(AssertionError), dask.config.set(scheduler="synchronous"):
        cohort["region_area"][5].compute()


def test_combine__only_the_selected_takes_are_read():
    """Whatever the number of takes in a block, whose values are in memory together."""
    reads = []

    class Noted:
        def __init__(self, number):
            self.number = number

        def read(self, name):
            reads.append(self.number)
            return Values(np.full((2, 3), self.number), {})

    none = {"x": 1}
    parts = [
        Part(f"T{i}", none, ["site_sigma_tr"], {"site": 2, "channel": 3}, {}, Noted(i))
        for i in range(600)
    ]
    parts[7] = Part("T7", none, [], {}, {}, Noted(7))
    values = combine(parts)["site_sigma_tr"]
    whole = np.broadcast_to(np.arange(600.0)[:, None, None], (600, 2, 3)).copy()
    whole[7] = np.nan
    for key in (
        (5,),
        (7,),
        (slice(254, 259), 1),
        ([300, 2, 2], slice(None), [2, 0]),
        (slice(None, None, 100), 0, 2),
        ([], slice(0, 1)),
    ):
        reads.clear()
        chosen = dict(zip(values.dims, key, strict=False))
        got = values.isel(chosen).compute(scheduler="synchronous").values
        want = whole
        for dim, index in reversed([*enumerate(key)]):
            index = np.asarray(index, int) if isinstance(index, list) else index
            want = want[(slice(None),) * dim + (index,)]
        np.testing.assert_array_equal(got, want)
        takes = {*np.atleast_1d(np.arange(600)[key[0]]).tolist()} if key[0] else set()
        if not isinstance(key[0], list):
            assert {*reads} == takes - {7}, key
    np.testing.assert_array_equal(values.values, whole)


def test_combine__labels_of_all_takes_together():
    def part(take, sites, count):
        sizes = {
            "site_status": np.ones((len(sites), 3), np.uint8),
            "site_sigma_tr": np.full((len(sites), 3), 2.0),
        }
        sample = {"surfel_area": np.full(count, 3.0), "surfel_index": np.arange(count)}
        variables = {
            name: (("site", "channel"), value) for name, value in sizes.items()
        }
        variables |= {name: ("surfel", value) for name, value in sample.items()}
        return Held.part(
            take,
            {"kind": take},
            xr.Dataset(variables, {"site": sites, "channel": list("RGB")}),
        )

    found = combine(
        [part("a", ["cheek"], 2), part("b", ["neck", "cheek"], 4)], sizes={"surfel": 3}
    )
    assert found["site"].values.tolist() == ["cheek", "neck"]
    np.testing.assert_array_equal(
        found["site_status"][:, :, 0], [[1, ProbeStatus.NOT_MEASURED], [1, 1]]
    )
    np.testing.assert_array_equal(found["surfel_index"], [[0, 1, -1], [0, 1, 2]])
    np.testing.assert_array_equal(found["surfel_area"], [[3, 3, np.nan], [3, 3, 3]])
    assert "site_status" not in combine(
        [part("a", ["cheek"], 2)], variables=["surfel_area"]
    )


@pytest.mark.parametrize(
    ("values", "dtype", "missing"),
    [
        ([1, 2], "int64", 0),
        ([1, None], "float64", 1),
        ([1.5, 2], "float64", 0),
        ([True, False], "bool", 0),
        ([True, None], "object", 1),
        (["a", None], "object", 1),
        ([1, "a"], "object", 0),
        ([None, None], "object", 2),
    ],
)
def test_column__types(values, dtype, missing):
    found = xr.DataArray(column(values))
    assert str(found.dtype) == dtype
    assert int(found.isnull().sum()) == missing


def test_cohort__groups_that_stay_open_hold_no_values(db):
    """Groups of hundreds of takes stay open; if they kept values, these would fill the memory."""
    cohort = db.cohort(
        "surfels", surfels=2000, variables=["diffuse_reflectance", "surfel_area"]
    ).load()
    take = str(cohort["take"].values[0])
    record = db.record("model", take)
    opened = _group(Address.of(db.place.address(), record), "sample")
    assert "diffuse_reflectance" in opened
    assert [
        name
        for name, variable in opened.data_vars.items()
        if variable.variable._in_memory
    ] == []

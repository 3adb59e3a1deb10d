"""`elementwise`: eager and lazy results agree, the kernel runs once per block, labels
are from the schema.
"""

from __future__ import annotations

import dask
import numpy as np
import pytest

from skindb.elementwise import elementwise
from skindb.schema import dataset


def _inputs(n: int = 10):
    rng = np.random.default_rng(1)
    return dataset(
        {
            "surfel_position": rng.normal(size=(n, 3)),
            "light_position": rng.normal(size=(4, 3)),
            "surfel_area": rng.uniform(size=n),
        },
        coords={"surfel": np.arange(n)},
    )


def _kernel(position, light, area, *, scale=1.0):
    fraction = scale * np.linalg.norm(position[:, None] - light, axis=-1)
    return fraction.astype(np.float32), (area * 2).astype(np.float32)


@pytest.mark.parametrize("chunk", [1, 3, 10])
def test_elementwise__any_chunking_same_bits(chunk):
    ds = _inputs()
    call = {
        "over": "surfel",
        "inputs": ["surfel_position", "light_position", "surfel_area"],
        "scale": 2.0,
    }
    eager = elementwise(
        _kernel, ds, outputs=["light_visible_fraction", "fit_residual"], **call
    )
    lazy = elementwise(
        _kernel,
        ds.chunk(surfel=chunk),
        outputs=["light_visible_fraction", "fit_residual"],
        **call,
    )
    assert lazy["fit_residual"].chunks is not None
    assert lazy.compute().identical(eager)
    assert eager["fit_residual"].attrs["units"] == "1"
    assert eager.sizes["surfel"] == 10


def test_elementwise__one_call_per_block():
    calls = []

    def counted(*blocks):
        calls.append(len(blocks[0]))
        return _kernel(*blocks)

    ds = _inputs().chunk(surfel=4)
    lazy = elementwise(
        counted,
        ds,
        over="surfel",
        inputs=["surfel_position", "light_position", "surfel_area"],
        outputs=["light_visible_fraction", "fit_residual"],
    )
    # dask may have called it on empty blocks to infer the type of the result
    calls.clear()
    with dask.config.set(scheduler="synchronous"):
        lazy.compute()
    assert sorted(c for c in calls if c) == [2, 4, 4]


def test_elementwise__one_output():
    def area(position, light, area):
        return (area * 2,)

    call = {
        "over": "surfel",
        "inputs": ["surfel_position", "light_position", "surfel_area"],
        "outputs": ["fit_residual"],
    }
    ds = _inputs()
    eager, lazy = (elementwise(area, one, **call) for one in (ds, ds.chunk(surfel=3)))
    assert lazy.compute().identical(eager)
    np.testing.assert_allclose(eager["fit_residual"], 2 * ds["surfel_area"])

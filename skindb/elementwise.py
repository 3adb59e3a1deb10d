"""Application of a numeric kernel to surfels (or profiles), lazily and block by block."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import dask
import numpy as np
from dask.system import cpu_count
from xarray import Dataset, apply_ufunc

from skindb.schema import VARIABLES, label
from skindb.types import AnyArray

Kernel = Callable[..., tuple[AnyArray, ...]]


def elementwise(
    kernel: Kernel,
    ds: Dataset,
    *,
    over: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    sizes: Mapping[str, int] | None = None,
    **params: Any,
) -> Dataset:
    """Run `kernel` on blocks along the dim `over`; lazy where the inputs are lazy.

    Parameters
    ----------
    kernel
        Function of one array per input, in order and with the dims of `ds`, and of
        `params` by keyword; returns one array per output with `over` first. It must
        treat elements independently, because blocks are arbitrary.
    ds
        Dataset with the inputs; `over` must be the first dim of those that have it.
    over
        Dim to split along.
    inputs, outputs
        Names of variables; the outputs must be declared in the schema.
    sizes
        Lengths of output dims that no input has.
    **params
        Keyword arguments of the kernel.

    Returns
    -------
    Dataset
        Only the outputs, labelled, with the coordinates of `ds` along their dims.
    """
    arrays = [ds[name].variable for name in inputs]
    specs = [VARIABLES[name] for name in outputs]
    lengths = {str(dim): size for dim, size in ds.sizes.items()} | dict(sizes or {})

    def declared(*blocks: AnyArray) -> Any:
        # convert the results of the kernel to the dtype of the schema, which the lazy
        # array declares
        results = kernel(*blocks, **params)
        arrays = tuple(
            np.asarray(r, spec.dtype) for r, spec in zip(results, specs, strict=True)
        )
        # apply_ufunc expects a single output without a tuple
        return arrays if len(arrays) > 1 else arrays[0]

    # one call of the kernel per block gives all outputs; inputs without `over` are
    # shared by every block
    results = apply_ufunc(
        declared,
        *arrays,
        input_core_dims=[
            [dim for dim in array.dims if dim != over] for array in arrays
        ],
        output_core_dims=[[dim for dim in spec.dims if dim != over] for spec in specs],
        dask="parallelized",
        output_dtypes=[spec.dtype for spec in specs],
        dask_gufunc_kwargs={
            "output_sizes": {
                dim: lengths[dim] for spec in specs for dim in spec.dims if dim != over
            }
        },
    )
    results = results if isinstance(results, tuple) else (results,)
    coords = {
        dim: ds.coords[dim] for spec in specs for dim in spec.dims if dim in ds.coords
    }
    return Dataset(
        {name: label(name, r.data) for name, r in zip(outputs, results, strict=True)},
        coords,
    )


def thread_count() -> int:
    """Number of threads that this process may use.

    This is the number that Dask is configured to use, or else one per available core (a
    batch job may use only some cores of its machine). `skindb.workflow.map_takes` sets
    it, so that parallel takes do not use more threads than cores.
    """
    return int(dask.config.get("num_workers", None) or cpu_count() or 1)

"""Compiled kernels: decorators, vector steps, half floats, order statistics.

LLVM vectorises loops only if their width is constant, and a call with many arrays costs
more than a step of a few vectors. These steps are therefore written with explicit vector
instructions and inlined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, event
from numba.extending import intrinsic, overload

from skindb.kernel_compiler import Kernel
from skindb.types import AnyArray, Matrix32, Vector, Vector32

# a kernel keeps its signature for mypy, which checks its callers
Function = TypeVar("Function", bound=Callable[..., Any])
# sums may be reordered and products fused; NaN and inf keep their meaning
# (`fastmath=True` would drop tests for them)
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
# without the GIL; a division by zero gives inf, because tests for it would prevent
# vectorised loops
OPTIONS: dict[str, Any] = {"nopython": True, "nogil": True, "error_model": "numpy"}


def kernel(function: Function) -> Function:
    """Compile a kernel whose sums keep their order."""
    return cast(Function, Kernel(function, OPTIONS))


def fast_kernel(function: Function) -> Function:
    """Compile a kernel whose loops may run in vector registers, see FAST.

    The kernel is always inlined into its callers. Otherwise a process that has just
    compiled both would call the separately compiled copy, and a process that reads them
    from the disk the copy next to the caller, which may sum in another order.
    """
    return cast(
        Function, Kernel(function, OPTIONS | {"fastmath": FAST, "forceinline": True})
    )


def inline_kernel(function: Function) -> Function:
    """Like `kernel`, but inlined by Numba into each of its callers."""
    return cast(Function, Kernel(function, OPTIONS | {"inline": "always"}))


def inline_fast_kernel(function: Function) -> Function:
    """Like `fast_kernel`, but inlined by Numba into each of its callers."""
    return cast(
        Function, Kernel(function, OPTIONS | {"fastmath": FAST, "inline": "always"})
    )


def is_stored(compiled: Any) -> bool:
    """Whether the disk has a kernel as Python calls it."""
    return not compiled.entry.files.is_empty()


@contextmanager
def reported_compilation(call: Callable[[], None]) -> Iterator[None]:
    """Call `call` before each kernel that is compiled instead of read from the disk, as
    after an installation.
    """

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:  # noqa: ARG002
            call()

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


# single-precision values per vector register; the width of the arrays below is a
# multiple of it
LANES = 8
VECTOR = ir.VectorType(ir.FloatType(), LANES)
STEP = ir.Constant(ir.IntType(64), LANES)
FUSED = ("contract",)  # a product and a sum may be one instruction


def _load(builder: Any, pointer: Any) -> Any:
    vector = builder.load(builder.bitcast(pointer, VECTOR.as_pointer()))
    vector.align = 4
    return vector


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, VECTOR.as_pointer())).align = 4


def _spread(builder: Any, value: Any) -> Any:
    """A vector with one value in all lanes."""
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    empty = ir.Constant(VECTOR, ir.Undefined)
    lane = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(lane, empty, lanes)


@intrinsic
def vector_blend(
    _typing: Any, table: Any, places: Any, weights: Any, rows: Any, row: Any
) -> Any:
    """rows[row] = sum over c of weights[c] times the values of the table from places[c] on.

    Tuples of int64 and float32; arrays (., width) of float32.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = context.make_array(signature.args[0])(context, builder, arguments[0])
        out = context.make_array(signature.args[3])(context, builder, arguments[3])
        width = cgutils.unpack_tuple(builder, source.shape, 2)[1]
        starts = cgutils.unpack_tuple(builder, arguments[1])
        factors = [
            _spread(builder, weight)
            for weight in cgutils.unpack_tuple(builder, arguments[2])
        ]
        begin = builder.mul(arguments[4], width)
        with cgutils.for_range(builder, builder.udiv(width, STEP)) as loop:
            offset = builder.mul(loop.index, STEP)
            total = None
            for start, factor in zip(starts, factors, strict=True):
                position = builder.add(start, offset)
                value = _load(builder, builder.gep(source.data, [position]))
                part = builder.fmul(value, factor, flags=FUSED)
                total = (
                    part if total is None else builder.fadd(total, part, flags=FUSED)
                )
            position = builder.add(begin, offset)
            _store(builder, total, builder.gep(out.data, [position]))
        return context.get_dummy_value()

    return types.void(table, places, weights, rows, row), codegen


@intrinsic
def vector_products(
    _typing: Any,
    rows: Any,
    weight: Any,
    target: Any,
    left: Any,
    right: Any,
    begin: Any,
    end: Any,
    out: Any,
) -> Any:
    """Sums over rows i from begin to end, all float32, out (9, 8).

    out[k, j] is that of weight[i] rows[i, left + k] rows[i, right + j], out[8, j] that
    of target[i] rows[i, right + j].
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, scale, aim, destination = (
            context.make_array(signature.args[k])(context, builder, arguments[k])
            for k in (0, 1, 2, 7)
        )
        width = cgutils.unpack_tuple(builder, source.shape, 2)[1]
        left, right, begin, end = arguments[3:7]
        sums = [cgutils.alloca_once(builder, VECTOR) for _ in range(LANES + 1)]
        for total in sums:
            builder.store(ir.Constant(VECTOR, [0.0] * LANES), total)
        with cgutils.for_range_slice(
            builder, begin, end, ir.Constant(ir.IntType(64), 1)
        ) as (row, _):
            start = builder.mul(row, width)
            position = builder.add(start, right)
            across = _load(builder, builder.gep(source.data, [position]))
            row_weight = builder.load(builder.gep(scale.data, [row]))
            weighted = builder.fmul(across, _spread(builder, row_weight))
            lane = builder.add(start, left)
            for k, total in enumerate(sums):
                if k < LANES:
                    column = builder.add(lane, ir.Constant(ir.IntType(64), k))
                    pointer = builder.gep(source.data, [column])
                else:
                    pointer = builder.gep(aim.data, [row])
                factor = _spread(builder, builder.load(pointer))
                step = weighted if k < LANES else across
                part = builder.fmul(factor, step, flags=FUSED)
                added = builder.fadd(builder.load(total), part, flags=FUSED)
                builder.store(added, total)
        for k, total in enumerate(sums):
            start = ir.Constant(ir.IntType(64), k * LANES)
            pointer = builder.gep(destination.data, [start])
            _store(builder, builder.load(total), pointer)
        return context.get_dummy_value()

    return types.void(rows, weight, target, left, right, begin, end, out), codegen


@intrinsic
def vector_dots(_typing: Any, rows: Any, factors: Any, count: Any, out: Any) -> Any:
    """out[i] = sum over j of rows[i, j] factors[j] for the first `count` rows; all float32."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, other, target = (
            context.make_array(signature.args[k])(context, builder, arguments[k])
            for k in (0, 1, 3)
        )
        width = cgutils.unpack_tuple(builder, source.shape, 2)[1]
        total = cgutils.alloca_once(builder, VECTOR)
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), VECTOR])
        reduce = cgutils.get_or_insert_function(
            builder.module, kind, "llvm.vector.reduce.fadd.v8f32"
        )
        with cgutils.for_range(builder, arguments[2]) as rows_loop:
            start = builder.mul(rows_loop.index, width)
            builder.store(ir.Constant(VECTOR, [0.0] * LANES), total)
            with cgutils.for_range(builder, builder.udiv(width, STEP)) as loop:
                offset = builder.mul(loop.index, STEP)
                position = builder.add(start, offset)
                row = _load(builder, builder.gep(source.data, [position]))
                factor = _load(builder, builder.gep(other.data, [offset]))
                part = builder.fmul(row, factor, flags=FUSED)
                added = builder.fadd(builder.load(total), part, flags=FUSED)
                builder.store(added, total)
            zero = ir.Constant(ir.FloatType(), 0.0)
            dot = builder.call(
                reduce, [zero, builder.load(total)], fastmath=("reassoc",)
            )
            builder.store(dot, builder.gep(target.data, [rows_loop.index]))
        return context.get_dummy_value()

    return types.void(rows, factors, count, out), codegen


@intrinsic
def vector_half(_typing: Any, bits: Any) -> Any:
    """The half float with these bits in single precision, converted by the processor."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fpext(
            builder.bitcast(arguments[0], ir.HalfType()), ir.FloatType()
        )

    return types.float32(bits), codegen


@intrinsic
def float_bits(_typing: Any, value: Any) -> Any:
    """The bits of a float32 as int32."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(value), codegen


@intrinsic
def bits_float(_typing: Any, bits: Any) -> Any:
    """The float32 with these bits."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(bits), codegen


def single(value: Any) -> Any:
    """A sample in single precision; half floats are passed as their bits, see `sample_bits`."""
    return value


@overload(single, inline="always", strict=False)
def _single(value: Any) -> Any:
    if value == types.uint16:
        return lambda value: vector_half(value)
    return lambda value: value


def sample_bits(sample: AnyArray) -> AnyArray:
    """Half floats as uint16 bits, because Numba has no half type; other samples in
    single precision.
    """
    if sample.dtype == np.float16:
        return np.ascontiguousarray(sample).view(np.uint16)
    return np.ascontiguousarray(sample, np.float32)


@kernel
def unpack(sample: AnyArray, out: Vector32) -> None:
    """Write the samples (lights, cameras, 3) of a surfel to `out` (lights cameras 3,)
    in single precision.
    """
    flat = sample.reshape(-1)
    for i in range(flat.shape[0]):
        out[i] = single(flat[i])


@kernel
def all_finite(values: Vector) -> bool:
    """Whether no value is NaN or infinite; the same by NumPy takes a second to compile."""
    finite = True
    for i in range(values.shape[0]):
        finite = finite and abs(values[i]) < np.inf
    return finite


@fast_kernel
def largest_finite(values: Vector32) -> np.float32:
    """Largest finite absolute value of (n,) values in single precision; 0 if there is none."""
    largest = np.float32(0)
    for i in range(values.shape[0]):
        size = abs(values[i])
        largest = max(largest, size if size < np.inf else np.float32(0))
    return largest


@kernel
def scale_to_one(values: Vector32) -> float:
    """Multiply values by the power of two that brings the largest to [0.5, 1), which is
    exact; returns the power.
    """
    largest = np.float64(largest_finite(values))
    if largest <= 0.0:
        return 1.0
    factor = np.float32(min(math.ldexp(1.0, -math.frexp(largest)[1]), 1e38))
    for i in range(values.shape[0]):
        values[i] *= factor
    return float(factor)


# bits of +inf; the bits of non-negative floats have the order of their values
INFINITE = np.int32(0x7F800000)
WINDOW = np.int32(256)  # units in the last place: a relative 3e-5


@kernel
def median_of(values: Vector32, n: int, count: int) -> float:
    """Median of n non-negative float32 of which `count` are finite and the others inf,
    to a relative error of 3e-5.

    Their bits are bisected by counting; values within WINDOW count as equal.
    """
    if count == 0:
        return 0.0
    low = INFINITE
    high = np.int32(0)
    for i in range(n):
        bits = float_bits(values[i])
        low = min(low, bits)
        high = max(high, bits if bits < INFINITE else np.int32(0))
    k = np.int32((count - 1) // 2)
    low = np.int32(low - 1)
    # at most k values are below or at `low`, more than k below or at `high`
    while high - low > WINDOW:
        middle = np.int32(low + (high - low) // 2)
        below = np.int32(0)
        for i in range(n):
            below += np.int32(float_bits(values[i]) <= middle)
        if below > k:
            high = middle
        else:
            low = middle
    below = np.int32(0)
    lower = np.float32(np.inf)
    upper = np.float32(np.inf)
    for i in range(n):
        bits = float_bits(values[i])
        below += np.int32(bits <= high)
        lower = min(lower, values[i] if bits > low else np.float32(np.inf))
        upper = min(upper, values[i] if bits > high else np.float32(np.inf))
    if count % 2 or below > k + 1:
        upper = lower
    return 0.5 * (np.float64(lower) + np.float64(upper))


@fast_kernel
def _exchange(low: Vector32, high: Vector32, n: int) -> None:
    for i in range(n):
        a = low[i]
        b = high[i]
        low[i] = a if a < b else b
        high[i] = b if a < b else a


@kernel
def sort_columns(x: Matrix32, rows: int, n: int) -> None:
    """Sort the first n columns of `x` along its first `rows` rows, all columns at once.

    Batcher's merge exchange (Knuth, volume 3, algorithm 5.2.2M). Values are finite or +inf.
    """
    top = 1
    while 2 * top < rows:
        top *= 2
    p = top
    while p > 0 and rows > 1:
        q = top
        r = 0
        d = p
        while True:
            for i in range(rows - d):
                if i & p == r:
                    _exchange(x[i], x[i + d], n)
            if q == p:
                break
            d = q - p
            q = q // 2
            r = p
        p //= 2

"""Steps of compiled kernels, written with explicit vector instructions and inlined, and
the same steps as plain loops.

LLVM vectorises loops only if their width is constant, and a call with many arrays costs
more than such a step. With SKINDB_INTRINSICS=0 in the environment the plain loops are
used, for processors or versions of LLVM on which the vector code does not compile. The
fit then takes about four times the CPU time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from skindb._compiled import INTRINSICS, inline_fast_kernel, kernel

# single-precision values per vector register; the width of the arrays below is a
# multiple of it
LANES = 8
VECTOR = ir.VectorType(ir.FloatType(), LANES)
STEP = ir.Constant(ir.IntType(64), LANES)
FUSED = ("contract",)  # a product and a sum may be one instruction


def _load(builder: Any, pointer: Any) -> Any:
    found = builder.load(builder.bitcast(pointer, VECTOR.as_pointer()))
    found.align = 4
    return found


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, VECTOR.as_pointer())).align = 4


def _spread(builder: Any, value: Any) -> Any:
    """A vector with one value in all lanes."""
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    empty = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, empty, lanes)


@intrinsic
def vector_blend(
    _typing: Any, table: Any, places: Any, weights: Any, rows: Any, row: Any
) -> Any:
    """rows[row] = sum over c of weights[c] table[places[c]].

    Tuples of int64 and float32; arrays (., width) of float32.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = context.make_array(signature.args[0])(context, builder, arguments[0])
        out = context.make_array(signature.args[3])(context, builder, arguments[3])
        width = cgutils.unpack_tuple(builder, source.shape, 2)[1]
        starts = [
            builder.mul(place, width)
            for place in cgutils.unpack_tuple(builder, arguments[1])
        ]
        factors = [
            _spread(builder, weight)
            for weight in cgutils.unpack_tuple(builder, arguments[2])
        ]
        begin = builder.mul(arguments[4], width)
        with cgutils.for_range(builder, builder.udiv(width, STEP)) as loop:
            at = builder.mul(loop.index, STEP)
            total = None
            for start, factor in zip(starts, factors, strict=True):
                value = _load(
                    builder, builder.gep(source.data, [builder.add(start, at)])
                )
                part = builder.fmul(value, factor, flags=FUSED)
                total = (
                    part if total is None else builder.fadd(total, part, flags=FUSED)
                )
            _store(builder, total, builder.gep(out.data, [builder.add(begin, at)]))
        return context.get_dummy_value()

    return types.void(table, places, weights, rows, row), codegen


@intrinsic
def vector_products(
    _typing: Any,
    rows: Any,
    weight: Any,
    given: Any,
    left: Any,
    right: Any,
    begin: Any,
    end: Any,
    out: Any,
) -> Any:
    """Sums over rows i from begin to end, all float32, out (9, 8).

    out[k, j] is that of weight[i] rows[i, left + k] rows[i, right + j], out[8, j] that
    of given[i] rows[i, right + j].
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = context.make_array(signature.args[0])(context, builder, arguments[0])
        scale = context.make_array(signature.args[1])(context, builder, arguments[1])
        aim = context.make_array(signature.args[2])(context, builder, arguments[2])
        target = context.make_array(signature.args[7])(context, builder, arguments[7])
        width = cgutils.unpack_tuple(builder, source.shape, 2)[1]
        left, right, begin, end = arguments[3:7]
        sums = [cgutils.alloca_once(builder, VECTOR) for _ in range(LANES + 1)]
        for total in sums:
            builder.store(ir.Constant(VECTOR, [0.0] * LANES), total)
        with cgutils.for_range_slice(
            builder, begin, end, ir.Constant(ir.IntType(64), 1)
        ) as (row, _):
            start = builder.mul(row, width)
            across = _load(
                builder, builder.gep(source.data, [builder.add(start, right)])
            )
            weighted = builder.fmul(
                across, _spread(builder, builder.load(builder.gep(scale.data, [row])))
            )
            lane = builder.add(start, left)
            ones = [
                builder.gep(
                    source.data, [builder.add(lane, ir.Constant(ir.IntType(64), k))]
                )
                for k in range(LANES)
            ]
            for k, place in enumerate([*ones, builder.gep(aim.data, [row])]):
                factor = _spread(builder, builder.load(place))
                part = builder.fmul(
                    factor, weighted if k < LANES else across, flags=FUSED
                )
                builder.store(
                    builder.fadd(builder.load(sums[k]), part, flags=FUSED), sums[k]
                )
        for k, total in enumerate(sums):
            place = builder.gep(target.data, [ir.Constant(ir.IntType(64), k * LANES)])
            _store(builder, builder.load(total), place)
        return context.get_dummy_value()

    return types.void(rows, weight, given, left, right, begin, end, out), codegen


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
                at = builder.mul(loop.index, STEP)
                row = _load(builder, builder.gep(source.data, [builder.add(start, at)]))
                part = builder.fmul(
                    row, _load(builder, builder.gep(other.data, [at])), flags=FUSED
                )
                builder.store(
                    builder.fadd(builder.load(total), part, flags=FUSED), total
                )
            zero = ir.Constant(ir.FloatType(), 0.0)
            found = builder.call(
                reduce, [zero, builder.load(total)], fastmath=("reassoc",)
            )
            builder.store(found, builder.gep(target.data, [rows_loop.index]))
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


@inline_fast_kernel
def plain_blend(table: Any, places: Any, weights: Any, rows: Any, row: Any) -> None:
    """`vector_blend` as loops."""
    width = rows.shape[1]
    flat = table.reshape(-1)
    for j in range(width):
        rows[row, j] = np.float32(0)
    for c in range(len(places)):
        start = places[c] * width
        for j in range(width):
            rows[row, j] += weights[c] * flat[start + j]


@kernel
def plain_products(
    rows: Any,
    weight: Any,
    given: Any,
    left: Any,
    right: Any,
    begin: Any,
    end: Any,
    out: Any,
) -> None:
    """`vector_products` as loops."""
    out[:] = np.float32(0)
    for i in range(begin, end):
        for j in range(LANES):
            weighted = rows[i, right + j] * weight[i]
            for k in range(LANES):
                out[k, j] += rows[i, left + k] * weighted
            out[LANES, j] += given[i] * rows[i, right + j]


@kernel
def plain_dots(rows: Any, factors: Any, count: Any, out: Any) -> None:
    """`vector_dots` as loops."""
    for i in range(count):
        total = np.float32(0)
        for j in range(rows.shape[1]):
            total += rows[i, j] * factors[j]
        out[i] = total


@kernel
def plain_half(bits: Any) -> Any:
    """`vector_half` with a table."""
    return HALVES[bits]


HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)
blend = vector_blend if INTRINSICS else plain_blend
products = vector_products if INTRINSICS else plain_products
dots = vector_dots if INTRINSICS else plain_dots
half = vector_half if INTRINSICS else plain_half

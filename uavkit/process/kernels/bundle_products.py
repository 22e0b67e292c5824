"""Products of small matrices added to blocks, in vector instructions: what a bundle spends most of its time on.

Compilers leave loops of six scalar; here the rows of a block are vectors of their own type (LLVM), which any processor
knows how to load, multiply and store.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from uavkit.process.kernels.jit import summing_kernel

Array = NDArray[np.float64]

_DOUBLE, _INT32, _INT64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)


def _at(builder: Any, base: Any, offset: int, kind: Any) -> Any:
    """Return the address of an element as a pointer to a scalar or vector."""
    return builder.bitcast(builder.gep(base, [ir.Constant(_INT64, offset)]), ir.PointerType(kind))


def _matrix(context: Any, builder: Any, kind: Any, array_and_number: Any, size: int) -> Any:
    """Return the address of one matrix of so many elements in an array of them."""
    array, number = array_and_number
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [builder.mul(number, ir.Constant(_INT64, size))])


def _broadcast(builder: Any, scalar: Any, size: int) -> Any:
    """Return a vector of equal elements."""
    vector = ir.VectorType(_DOUBLE, size)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(_INT32, 0))
    places = ir.Constant(ir.VectorType(_INT32, size), [0] * size)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), places)


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def _product(
    _: Any, into: Any, at: Any, left: Any, left_at: Any, right: Any, right_at: Any, kind: Any  # noqa: ARG001
) -> Any:  # fmt: skip
    """Add a product of contiguous small matrices to another, each the at-th of its array; indexes are not checked.

    kind is a literal of digits s h r w: into (h, w) += left^T right with left (r, h) and right (r, w); s is 1, 2 to
    subtract, or 3 to add left right with left (h, r).
    """
    if not isinstance(kind, types.IntegerLiteral):
        return None
    way, height, rows, width = (int(digit) for digit in str(kind.literal_value))
    vector, free = ir.VectorType(_DOUBLE, width), ("contract",)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sizes = height * width, rows * height, rows * width
        out, a, b = (
            _matrix(context, builder, signature.args[2 * k], arguments[2 * k : 2 * k + 2], sizes[k]) for k in range(3)
        )
        lines = [builder.load(_at(builder, b, row * width, vector), align=8) for row in range(rows)]
        for k in range(height):
            place = _at(builder, out, k * width, vector)
            total = builder.load(place, align=8)
            for row in range(rows):
                at = k * rows + row if way == 3 else row * height + k
                scalar = builder.load(_at(builder, a, at, _DOUBLE))
                product = builder.fmul(_broadcast(builder, scalar, width), lines[row], flags=free)
                total = (builder.fsub if way == 2 else builder.fadd)(total, product, flags=free)
            builder.store(total, place, align=8)
        return context.get_dummy_value()

    return types.void(into, types.int64, left, types.int64, right, types.int64, kind), code


@summing_kernel
def add_squares(blocks: Array, at: int, designs: Array, a: int) -> None:
    """Add J^T J, of two rows J (2, d), to a block (d, d)."""
    size = blocks.shape[1]
    if size == 6:
        _product(blocks, at, designs, a, designs, a, 1626)
    elif size == 9:
        _product(blocks, at, designs, a, designs, a, 1929)
    else:
        block, design = blocks[at], designs[a]
        for k in range(size):
            a0, a1 = design[0, k], design[1, k]
            for m in range(size):
                block[k, m] += a0 * design[0, m] + a1 * design[1, m]


@summing_kernel
def subtract_product(blocks: Array, at: int, matrices: Array, a: int, b: int) -> None:
    """Subtract left^T right, of three rows (3, d), the a-th and b-th matrix, from a block (d, d)."""
    size = blocks.shape[1]
    if size == 6:
        _product(blocks, at, matrices, a, matrices, b, 2636)
    elif size == 9:
        _product(blocks, at, matrices, a, matrices, b, 2939)
    else:
        block, left, right = blocks[at], matrices[a], matrices[b]
        for k in range(size):
            a0, a1, a2 = left[0, k], left[1, k], left[2, k]
            for m in range(size):
                block[k, m] -= a0 * right[0, m] + a1 * right[1, m] + a2 * right[2, m]


@summing_kernel
def add_left_product(outs: Array, b: int, turned: Array, a: int, blocks: Array, at: int) -> None:
    """Add turned^T block to out (3, d), with turned (d, 3) and a block (d, d)."""
    size = blocks.shape[1]
    if size == 6:
        _product(outs, b, turned, a, blocks, at, 1366)
    elif size == 9:
        _product(outs, b, turned, a, blocks, at, 1399)
    else:
        out, left, block = outs[b], turned[a], blocks[at]
        for k in range(size):
            a0, a1, a2 = left[k, 0], left[k, 1], left[k, 2]
            for m in range(size):
                out[0, m] += a0 * block[k, m]
                out[1, m] += a1 * block[k, m]
                out[2, m] += a2 * block[k, m]


@summing_kernel
def add_right_product(outs: Array, a: int, blocks: Array, at: int, turned: Array, b: int) -> None:
    """Add block turned to out (d, 3), with turned (d, 3) and a block (d, d)."""
    size = blocks.shape[1]
    if size == 6:
        _product(outs, a, blocks, at, turned, b, 3663)
    elif size == 9:
        _product(outs, a, blocks, at, turned, b, 3993)
    else:
        out, block, right = outs[a], blocks[at], turned[b]
        for k in range(size):
            for m in range(size):
                factor = block[k, m]
                for r in range(3):
                    out[k, r] += factor * right[m, r]

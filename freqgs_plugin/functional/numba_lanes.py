"""Several numbers as one value in compiled kernels: LLVM's own vectors, so that speed does not hang on what its loop
vectoriser makes of a loop.

`Lanes` are of float32 or float64. They are added, subtracted, multiplied, divided and compared with Lanes or numbers of
that type, elementwise; a comparison gives a mask. Arithmetic assumes finite numbers and may be reordered, as numba's
`fastmath` does. On a CPU whose registers are narrower LLVM splits the vectors.
"""

import operator
from typing import Any

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic as _intrinsic
from numba.extending import lower_builtin, lower_cast, models, register_model

LANES = 16 if get_host_cpu_features().get("avx512f") else 8
"""numbers in one value: as many float32 as one register holds, and of float64 what two hold"""

_FLAGS = ("reassoc", "contract", "nsz", "arcp", "nnan", "ninf")


def intrinsic(function: Any) -> Any:
    """numba's `intrinsic`; callers do not pass its first argument, which type checkers cannot know."""
    return _intrinsic(function)  # pyright: ignore[reportOptionalCall]


class _Vector(types.Type):
    """Type of Lanes of `element`, or of a mask (boolean)."""

    def __init__(self, element: Any):
        super().__init__(f"{element}x{LANES}")
        self.element = element

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        from numba.core.typeconv import Conversion

        return Conversion.promote if self is not mask_type and other == self.element else None


lanes_type, mask_type = _Vector(types.float32), _Vector(types.boolean)
_KINDS = {types.float32: lanes_type, types.float64: _Vector(types.float64)}
_IR = {types.float32: ir.FloatType(), types.float64: ir.DoubleType(), types.boolean: ir.IntType(1)}


def _ir(kind: Any) -> ir.VectorType:
    return ir.VectorType(_IR[kind.element], LANES)


@register_model(_Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: _Vector):
        super().__init__(manager, kind, _ir(kind))


def _broadcast(builder: Any, number: Any) -> Any:
    none = ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined)
    vector = builder.insert_element(none, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(vector, none, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _elementwise(operation: Any, is_comparison: bool, build: Any) -> None:
    """Teach numba `operation` on two Lanes, or Lanes and a number."""

    @infer_global(operation)  # pyright: ignore[reportOptionalCall]
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            for kind in _KINDS.values():
                if kind in args and all(a in (kind, kind.element) for a in args):
                    return signature(mask_type if is_comparison else kind, *[kind] * len(args))
            return None

    for kind in _KINDS.values():

        @lower_builtin(operation, kind, kind)
        def _(context, builder, sig, args):  # pyright: ignore[reportUnusedParameter]
            return build(builder, *args)


for _kind in _KINDS.values():

    @lower_cast(_kind.element, _kind)
    def _(context, builder, source, target, value):  # pyright: ignore[reportUnusedParameter]
        return _broadcast(builder, value)


_elementwise(operator.add, False, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_elementwise(operator.sub, False, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_elementwise(operator.mul, False, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_elementwise(operator.truediv, False, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_elementwise(operator.gt, True, lambda builder, a, b: builder.fcmp_ordered(">", a, b, flags=_FLAGS))
_elementwise(operator.ge, True, lambda builder, a, b: builder.fcmp_ordered(">=", a, b, flags=_FLAGS))
_elementwise(operator.lt, True, lambda builder, a, b: builder.fcmp_ordered("<", a, b, flags=_FLAGS))


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _ir(_KINDS[kind.dtype]).as_pointer())


@intrinsic
def load(typingctx, array, index):
    """The Lanes at array[index : index + LANES] of a contiguous array [n]; bounds are not checked."""

    def build(context, builder, sig, args):
        return builder.load(_address(context, builder, sig.args[0], *args), align=4)

    return _KINDS[array.dtype](array, types.intp), build


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + LANES] = value, as `load` reads."""

    def build(context, builder, sig, args):
        builder.store(args[2], _address(context, builder, sig.args[0], *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, _KINDS[array.dtype]), build


@intrinsic
def prefetch_to_write(typingctx, array, index):
    """Ask for the cache line of the index-th number of a contiguous array, to be written soon."""

    def build(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        address = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        # to write, into the second-level cache, data
        builder.call(function, [address, i32(1), i32(2), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), build


@intrinsic
def lanes(typingctx, number):
    """All lanes equal to a number."""
    return _KINDS[number](number), lambda context, builder, sig, args: _broadcast(builder, args[0])


@intrinsic
def select(typingctx, mask, a, b):
    """a where the mask is set, else b."""

    def build(context, builder, sig, args):
        return builder.select(*args)

    return a(mask_type, a, a), build


@intrinsic
def minimum(typingctx, a, b):
    """The lesser, lane by lane."""

    def build(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args, flags=_FLAGS), *args)

    return a(a, a), build


@intrinsic
def maximum(typingctx, a, b):
    """The greater, lane by lane."""

    def build(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args, flags=_FLAGS), *args)

    return a(a, a), build


@intrinsic
def magnitude(typingctx, a):
    """Absolute value, lane by lane."""

    def build(context, builder, sig, args):
        vector, name = _ir(a), f"llvm.fabs.v{LANES}f{a.element.bitwidth}"
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), name)
        return builder.call(function, args)

    return a(a), build


@intrinsic
def any_set(typingctx, mask):
    """Whether any lane of a mask is set."""

    def build(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask_type), build


TOTALS = 16
"""how many sums `store_totals` makes"""


@intrinsic
def store_totals(typingctx, array, index, values):
    """array[index + k] = sum of all lanes of values[k]: a tuple of TOTALS Lanes, a contiguous array [n], float32.

    Lanes are added pairwise while sums of different values move together: a third of the work of one sum after another.
    """

    def build(context, builder, sig, args):
        rows = cgutils.unpack_tuple(builder, args[2])
        for start in range(0, TOTALS, LANES):
            sums = rows[start : start + LANES]
            width = LANES
            while width > 1:
                width //= 2
                pairs = zip(sums[: len(sums) // 2], sums[len(sums) // 2 :], strict=True)
                sums = [_fold(builder, a, b, width) for a, b in pairs]
            at = builder.add(args[1], ir.Constant(args[1].type, start))
            builder.store(sums[0], _address(context, builder, sig.args[0], args[0], at), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.UniTuple(lanes_type, TOTALS)), build


def _fold(builder: Any, a: Any, b: Any, width: int) -> Any:
    """Of each block of 2 * `width` lanes the sum of its halves: a's in the lower half, b's in the upper."""
    order = ir.VectorType(ir.IntType(32), LANES)
    block = [(lane // (2 * width) * 2 * width + lane % width, lane // width % 2 * LANES) for lane in range(LANES)]
    halves = (ir.Constant(order, [lane + source + shift for lane, source in block]) for shift in (0, width))
    low, high = (builder.shuffle_vector(a, b, half) for half in halves)
    return builder.fadd(low, high, flags=_FLAGS)


@intrinsic
def add_row(typingctx, sums, array, index):
    """sums[k] += array[index + k] for k < TOTALS, of contiguous arrays: float64 [TOTALS] and float32 [n]."""

    def build(context, builder, sig, args):
        wide = ir.VectorType(ir.DoubleType(), TOTALS)
        row = ir.VectorType(ir.FloatType(), TOTALS)
        source = context.make_array(sig.args[1])(context, builder, args[1]).data
        numbers = builder.load(builder.bitcast(builder.gep(source, [args[2]]), row.as_pointer()), align=4)
        target = builder.bitcast(context.make_array(sig.args[0])(context, builder, args[0]).data, wide.as_pointer())
        before = builder.load(target, align=8)
        builder.store(builder.fadd(before, builder.fpext(numbers, wide)), target, align=8)
        return context.get_dummy_value()

    return types.void(sums, array, types.intp), build

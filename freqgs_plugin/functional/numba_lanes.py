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


@intrinsic
def total(typingctx, a):
    """Sum of all lanes."""

    def build(context, builder, sig, args):
        value, width = args[0], LANES
        while width > 1:
            width //= 2
            order = ir.VectorType(ir.IntType(32), LANES)
            upper = ir.Constant(order, [(i + width) % LANES for i in range(LANES)])
            value = builder.fadd(value, builder.shuffle_vector(value, value, upper), flags=_FLAGS)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return a.element(a), build

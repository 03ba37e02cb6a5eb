"""Sixteen numbers at a time: a vector type for Numba kernels, whose operations are single instructions of a CPU.

A kernel that is written with it is the same text for one lane as for sixteen, and does not depend on what a compiler
recognises in loops. Numbers mix with vectors as in formulas: ``2 * x + y``. There are no branches by lane: ``select``
takes one of two values. A product and a sum may become one instruction; nothing else is reordered.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

LANES = 16
# Without counts of references to arrays: every slice would be counted, which takes longer than what is done with some.
_OPTIONS: dict[str, Any] = {"boundscheck": False, "error_model": "numpy", "nogil": True, "_nrt": False}
# What only kernels call needs no way in from Python, whose making takes a third of the time to compile.
_INNER: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
law = njit(**_INNER, forceinline=True)
part = njit(**_INNER)
fast = njit(**_OPTIONS, cache=True)
FLAGS = ("nsz", "arcp", "contract")


class Vector(types.Type):
    """Sixteen float32 or float64."""

    def __init__(self, item: types.Float) -> None:
        self.item = item
        super().__init__(name=f"Vector({item})")

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Conversion | None:
        """A number stands for sixteen equal ones."""
        return Conversion.safe if isinstance(other, (types.Number, types.Literal)) else None


class Mask(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__(name="Mask")


mask = Mask()
_FLOATS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}
_BITS = {types.float32: 32, types.float64: 64}


def _vector_of(item: types.Float) -> ir.VectorType:
    return ir.VectorType(_FLOATS[item], LANES)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, _vector_of(kind.item))


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Mask) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), LANES))


def _splat(builder: Any, value: Any) -> Any:
    kind = ir.VectorType(value.type, LANES)
    if isinstance(value, ir.Constant):
        return ir.Constant(kind, [value.constant] * LANES)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(
        one, ir.Constant(kind, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    )


@lower_cast(types.Number, Vector)
def _from_number(context: Any, builder: Any, given: types.Type, wanted: Vector, value: Any) -> Any:
    return _splat(builder, context.cast(builder, value, given, wanted.item))


@lower_cast(types.IntegerLiteral, Vector)
def _from_literal(context: Any, builder: Any, given: types.Type, wanted: Vector, value: Any) -> Any:
    return _splat(builder, ir.Constant(_FLOATS[wanted.item], float(given.literal_value)))


def _item(args: tuple[types.Type, ...]) -> Vector | None:
    return next((a for a in args if isinstance(a, Vector)), None)


def _arithmetic(op: Any, name: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: tuple[types.Type, ...], kws: Any) -> Any:
            vector = _item(args)
            if vector is None or not all(isinstance(a, (Vector, types.Number)) for a in args):
                return None
            return signature(vector, *[vector] * len(args))

    infer_global(op)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, name)(*args, flags=FLAGS)

    lower_builtin(op, Vector, Vector)(lower)


for _op, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
    _arithmetic(_op, _name)
for _op, _name in ((operator.iadd, "fadd"), (operator.isub, "fsub"), (operator.imul, "fmul")):
    _arithmetic(_op, _name)


@infer_global(operator.neg)
class _Negative(AbstractTemplate):
    def generic(self, args: tuple[types.Type, ...], kws: Any) -> Any:
        return signature(args[0], args[0]) if isinstance(args[0], Vector) else None


@lower_builtin(operator.neg, Vector)
def _negative(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0], flags=FLAGS)


def _comparison(op: Any, text: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: tuple[types.Type, ...], kws: Any) -> Any:
            vector = _item(args)
            return None if vector is None else signature(mask, vector, vector)

    infer_global(op)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.fcmp_ordered(text, *args)

    lower_builtin(op, Vector, Vector)(lower)


for _op, _name in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _comparison(_op, _name)


def _logic(op: Any, name: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: tuple[types.Type, ...], kws: Any) -> Any:
            return signature(mask, mask, mask) if all(isinstance(a, Mask) for a in args) else None

    infer_global(op)(Template)
    lower_builtin(op, Mask, Mask)(lambda context, builder, sig, args: getattr(builder, name)(*args))


_logic(operator.and_, "and_")
_logic(operator.or_, "or_")


@infer_global(operator.invert)
class _Not(AbstractTemplate):
    def generic(self, args: tuple[types.Type, ...], kws: Any) -> Any:
        return signature(mask, mask) if isinstance(args[0], Mask) else None


@lower_builtin(operator.invert, Mask)
def _not(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.not_(args[0])


def _pointer(context: Any, builder: Any, kind: Any, array: Any, at: Any, item: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), ir.PointerType(item))


@intrinsic
def load(typingctx: Any, a: Any, at: Any) -> Any:
    """Sixteen numbers of a flat array from ``at`` on."""
    vector = Vector(a.dtype)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _vector_of(vector.item))
        return builder.load(pointer, align=_BITS[vector.item] // 8)

    return vector(a, types.intp), lower


@intrinsic
def store(typingctx: Any, a: Any, at: Any, value: Any) -> Any:
    """Write sixteen numbers into a flat array from ``at`` on."""
    vector = Vector(a.dtype)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _vector_of(vector.item))
        builder.store(args[2], pointer, align=_BITS[vector.item] // 8)
        return context.get_dummy_value()

    return types.void(a, types.intp, vector), lower


@intrinsic
def select(typingctx: Any, which: Any, yes: Any, no: Any) -> Any:
    """In each lane, the first value where the condition holds, else the second."""
    vector = _item((yes, no))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return vector(mask, vector, vector), lower


def _call(name: str, count: int) -> Any:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = _vector_of(sig.return_type.item)
        suffix = f"v{LANES}f{_BITS[sig.return_type.item]}"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * count), f"llvm.{name}.{suffix}"
        )
        return builder.call(function, args, fastmath=FLAGS)

    return lower


@intrinsic
def square_root(typingctx: Any, x: Any) -> Any:
    """Of each lane."""
    return x(x), _call("sqrt", 1)


@intrinsic
def magnitude(typingctx: Any, x: Any) -> Any:
    """Absolute value of each lane."""
    return x(x), _call("fabs", 1)


@intrinsic
def larger(typingctx: Any, x: Any, y: Any) -> Any:
    """In each lane; of a NaN and a number, the number."""
    vector = _item((x, y))
    return vector(vector, vector), _call("maxnum", 2)


@intrinsic
def smaller(typingctx: Any, x: Any, y: Any) -> Any:
    """In each lane; of a NaN and a number, the number."""
    vector = _item((x, y))
    return vector(vector, vector), _call("minnum", 2)


@intrinsic
def any_lane(typingctx: Any, which: Any) -> Any:
    """Whether a condition holds in any lane."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), lower


@intrinsic
def total(typingctx: Any, x: Any) -> Any:
    """Sum of the lanes, in a fixed order."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        found, width = args[0], LANES
        integer = ir.IntType(32)
        while width > 1:
            width //= 2
            kind = ir.VectorType(integer, width)
            low, high = (
                builder.shuffle_vector(
                    found, ir.Constant(found.type, ir.Undefined), ir.Constant(kind, list(range(begin, begin + width)))
                )
                for begin in (0, width)
            )
            found = builder.fadd(low, high)
        return builder.extract_element(found, integer(0))

    return x.item(x), lower


@intrinsic
def split(typingctx: Any, x: Any) -> Any:
    """A positive number as m 2^e, with m from about 0.7 to 1.4: m, and e as a float."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = _BITS[x.item]
        fraction = 23 if bits == 32 else 52
        integer = ir.VectorType(ir.IntType(bits), LANES)
        # Bits of sqrt(1/2): what is taken off is a whole number of powers of two.
        low = 0x3F3504F3 if bits == 32 else 0x3FE6A09E667F3BCD

        def constant(number: int) -> Any:
            return ir.Constant(integer, [number] * LANES)

        raw = builder.bitcast(args[0], integer)
        power = builder.ashr(builder.sub(raw, constant(low)), constant(fraction))
        rest = builder.bitcast(builder.sub(raw, builder.shl(power, constant(fraction))), args[0].type)
        power = builder.sitofp(power, args[0].type)
        return context.make_tuple(builder, sig.return_type, (rest, power))

    return types.UniTuple(x, 2)(x), lower


@intrinsic
def rough_cube_root(typingctx: Any, x: Any) -> Any:
    """1 / cube root of a positive number, to a few per cent, from its bits."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = _BITS[x.item]
        integer = ir.VectorType(ir.IntType(bits), LANES)
        # x^(-1/3): exponent -e/3, in units of the bits; the constant centres the error.
        magic = 0x54A21D2A if bits == 32 else 0x553EF0FF289DD796
        float_type = args[0].type
        raw = builder.bitcast(args[0], integer)
        third = builder.fptosi(
            builder.fmul(builder.sitofp(raw, float_type), ir.Constant(float_type, [1 / 3] * LANES)), integer
        )
        return builder.bitcast(builder.sub(ir.Constant(integer, [magic] * LANES), third), float_type)

    return x(x), lower

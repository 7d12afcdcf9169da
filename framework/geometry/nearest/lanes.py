"""Short vectors for functions compiled by numba: sixteen numbers that are computed together.

A value of type `Lanes` holds 16 numbers (4 if a name ends in 4) of an array's dtype, or as many truth values. `-`, `+`,
`*`, `&`, `|` and the comparisons work lane by lane on two values of one type. Vectors are LLVM's own, so that the
compiler maps them to the registers of the processor: one, two or four. No function checks bounds.

`no_type_check` keeps the type checks that tests switch on away from functions that numba calls while it compiles.
"""

import operator
from collections.abc import Callable
from typing import Any, no_type_check

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic, models, register_model
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

LANES = 16
INT32 = ir.IntType(32)
Make = Callable[..., Any]
"""Function that emits code: (builder, element type, values…) → value."""


class Lanes(types.Type):
    """Numba type of `count` numbers of the scalar type `element`."""

    @no_type_check
    def __init__(self, element, count=LANES):
        self.element, self.count = element, count
        super().__init__(name=f"Lanes({element}, {count})")


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    """An LLVM vector, in memory and in registers; truth values have one bit."""

    @no_type_check
    def __init__(self, manager, kind):
        truth = kind.element == types.boolean
        element = ir.IntType(1) if truth else manager.lookup(kind.element).get_value_type()
        super().__init__(manager, kind, ir.VectorType(element, kind.count))


@no_type_check
def real(element):
    """Return true if the element type is floating-point."""
    return isinstance(element, types.Float)


@no_type_check
def truths(like):
    """Return the type of truth values with as many lanes as `like`."""
    return Lanes(types.boolean, like.count)


@no_type_check
def arithmetic(of_reals: str, of_integers: str) -> Make:
    """Return the emitter of an operation on reals or integers."""

    def make(builder, element, x, y):
        return getattr(builder, of_reals if real(element) else of_integers)(x, y)

    return make


@no_type_check
def comparison(sign: str) -> Make:
    """Return the emitter of a comparison."""

    def make(builder, element, x, y):
        compare = builder.fcmp_ordered if real(element) else builder.icmp_signed  # False for NaN
        return compare(sign, x, y)

    return make


@no_type_check
def register(operation: Make, make: Make, compares: bool = False) -> None:
    """Register type and code of an operator on two vectors."""

    @infer_global(operation)  # type: ignore[reportOptionalCall]
    class Template(AbstractTemplate):
        @no_type_check
        def generic(self, arguments, _):
            if len(arguments) == 2 and isinstance(arguments[0], Lanes) and arguments[0] == arguments[1]:
                return signature(truths(arguments[0]) if compares else arguments[0], *arguments)
            return None

    @lower_builtin(operation, Lanes, Lanes)
    @no_type_check
    def lower(context, builder, sig, values):
        return make(builder, sig.args[0].element, *values)


register(operator.add, arithmetic("fadd", "add"))
register(operator.sub, arithmetic("fsub", "sub"))
register(operator.mul, arithmetic("fmul", "mul"))
register(operator.and_, arithmetic("and_", "and_"))
register(operator.or_, arithmetic("or_", "or_"))
register(operator.lt, comparison("<"), compares=True)
register(operator.le, comparison("<="), compares=True)
register(operator.eq, comparison("=="), compares=True)
register(operator.ne, comparison("!="), compares=True)


@no_type_check
def least_of(builder, element, x, y):
    """Emit the smaller value of each lane."""
    return builder.select(comparison("<")(builder, element, x, y), x, y)


@no_type_check
def most_of(builder, element, x, y):
    """Emit the larger value of each lane."""
    return builder.select(comparison(">")(builder, element, x, y), x, y)


@no_type_check
def coded(result, arguments, make):
    """Return the signature of an intrinsic and its code generator, which depends on the values alone."""

    def generate(context, builder, sig, values):
        return make(builder, *values)

    return result(*arguments), generate


@intrinsic
@no_type_check
def least(typing, a, b):
    """Return the smaller number in each lane; b if a is NaN."""
    return coded(a, (a, b), lambda builder, x, y: least_of(builder, a.element, x, y))


@intrinsic
@no_type_check
def most(typing, a, b):
    """Return the larger number in each lane; b if a is NaN."""
    return coded(a, (a, b), lambda builder, x, y: most_of(builder, a.element, x, y))


@intrinsic
@no_type_check
def where(typing, truth, a, b):
    """Return a in lanes that are true, b in the others."""
    return coded(a, (truth, a, b), lambda builder, t, x, y: builder.select(t, x, y))


@intrinsic
@no_type_check
def fma(typing, a, b, c):
    """Return a·b + c, rounded once if the processor can; the result is the same everywhere on one machine."""
    kind = {types.float32: "f32", types.float64: "f64"}[a.element]

    def make(builder, *values):
        vector = values[0].type
        declared = ir.FunctionType(vector, [vector] * 3)
        name = f"llvm.fmuladd.v{a.count}{kind}"
        return builder.call(cgutils.get_or_insert_function(builder.module, declared, name), values)

    return coded(a, (a, a, a), make)


@intrinsic
@no_type_check
def splat(typing, number):
    """Return a vector with the number in every lane."""

    def generate(context, builder, sig, values):
        vector = context.get_value_type(sig.return_type)
        empty = ir.Constant(vector, ir.Undefined)
        with_number = builder.insert_element(empty, values[0], ir.Constant(INT32, 0))
        return builder.shuffle_vector(with_number, empty, places([0] * LANES))

    return Lanes(number)(number), generate


@no_type_check
def places(indices):
    """Return a constant vector of lane indices."""
    return ir.Constant(ir.VectorType(INT32, len(indices)), indices)


@no_type_check
def folded(vector, combine):
    """Return the number to which `combine` reduces all lanes."""

    def make(builder, value):
        count = vector.count
        while count > 1:
            count //= 2
            empty = ir.Constant(value.type, ir.Undefined)
            low, high = (
                builder.shuffle_vector(value, empty, places(list(range(start, start + count))))
                for start in (0, count)
            )
            value = combine(builder, vector.element, low, high)
        return builder.extract_element(value, ir.Constant(INT32, 0))

    return coded(vector.element, (vector,), make)


@intrinsic
@no_type_check
def lowest(typing, vector):
    """Return the smallest number of all lanes."""
    return folded(vector, least_of)


@intrinsic
@no_type_check
def highest(typing, vector):
    """Return the largest number of all lanes."""
    return folded(vector, most_of)


@intrinsic
@no_type_check
def total(typing, vector):
    """Return the sum of all lanes."""
    return folded(vector, arithmetic("fadd", "add"))


@intrinsic
@no_type_check
def bits(typing, truth):
    """Return an int64 with lane i as bit i."""

    def make(builder, value):
        return builder.zext(builder.bitcast(value, ir.IntType(truth.count)), ir.IntType(64))

    return coded(types.int64, (truth,), make)


@intrinsic
@no_type_check
def mask(typing, number):
    """Return the 16 lowest bits of an int64 as truth values."""

    def make(builder, value):
        return builder.bitcast(builder.trunc(value, ir.IntType(LANES)), ir.VectorType(ir.IntType(1), LANES))

    return coded(Lanes(types.boolean), (number,), make)


@intrinsic
@no_type_check
def first(typing, number):
    """Return the index of the lowest set bit of an int64 that is not 0."""
    return coded(types.int64, (number,), lambda builder, x: builder.cttz(x, ir.Constant(ir.IntType(1), 1)))


@intrinsic
@no_type_check
def how_many(typing, number):
    """Return the number of set bits."""
    return coded(types.int64, (number,), lambda builder, x: builder.ctpop(x))


@intrinsic
@no_type_check
def whole(typing, vector):
    """Return the numbers rounded towards zero, as int32; they must fit."""
    result = Lanes(types.int32, vector.count)
    return coded(result, (vector,), lambda builder, x: builder.fptosi(x, ir.VectorType(INT32, vector.count)))


@intrinsic
@no_type_check
def lane(typing, vector, index):
    """Return the number in one lane."""
    return coded(vector.element, (vector, types.intp), lambda builder, x, i: builder.extract_element(x, i))


@intrinsic
@no_type_check
def with_id(typing, vector, number):
    """Return four lanes whose last holds the bits of an integer (int32 beside float32, int64 beside float64)."""
    width = vector.element.bitwidth

    def make(builder, value, whole_number):
        if width == 32:
            whole_number = builder.trunc(whole_number, INT32)
        return builder.insert_element(
            value, builder.bitcast(whole_number, value.type.element), ir.Constant(INT32, 3)
        )

    return coded(vector, (vector, types.int64), make)


@no_type_check
def pointer(context, builder, sig, values):
    """Return the address of element values[1] of the 1-D contiguous array values[0]."""
    array = context.make_array(sig.args[0])(context, builder, values[0])
    return builder.gep(array.data, [values[1]])


@intrinsic
@no_type_check
def take(typing, array, index):
    """Return one element; index ≥ 0."""

    def generate(context, builder, sig, values):
        return builder.load(pointer(context, builder, sig, values))

    return array.dtype(array, types.intp), generate


@no_type_check
def loaded(array, stride, parts, count=LANES):
    """Return `parts` vectors; part c holds elements c, c + stride, c + 2 stride, … from a start."""
    vector = Lanes(array.dtype, count)

    def generate(context, builder, sig, values):
        line = ir.VectorType(context.get_value_type(array.dtype), count * stride)
        address = builder.bitcast(pointer(context, builder, sig, values), line.as_pointer())
        value = builder.load(address, align=array.dtype.bitwidth // 8)
        if stride == 1:
            return value
        empty = ir.Constant(line, ir.Undefined)
        vectors = [
            builder.shuffle_vector(value, empty, places([stride * i + part for i in range(count)]))
            for part in range(parts)
        ]
        return context.make_tuple(builder, sig.return_type, vectors)

    result = vector if stride == 1 else types.UniTuple(vector, parts)
    return result(array, types.intp), generate


@intrinsic
@no_type_check
def load(typing, array, start):
    """Return 16 elements from a start."""
    return loaded(array, 1, 1)


@intrinsic
@no_type_check
def load4(typing, array, start):
    """Return 4 elements from a start."""
    return loaded(array, 1, 1, 4)


@intrinsic
@no_type_check
def load_triples(typing, array, start):
    """Return x, y, z of 16 points that are stored as x y z x y z and so on."""
    return loaded(array, 3, 3)


@intrinsic
@no_type_check
def load_quadruples(typing, array, start):
    """Return the four parts of 16 records that are stored as x y z w x y z w and so on."""
    return loaded(array, 4, 4)


@intrinsic
@no_type_check
def store(typing, array, start, vector):
    """Write a vector to an array from a start."""

    def generate(context, builder, sig, values):
        address = pointer(context, builder, sig, values)
        address = builder.bitcast(address, context.get_value_type(vector).as_pointer())
        builder.store(values[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate

"""Short vectors for functions compiled by numba: sixteen numbers that are computed together.

A value of type `Lanes` holds 16 numbers (4 if the function's name ends in 4) of an array's dtype, or as many truth
values. The position of a number in the vector is called a lane. `-`, `+`, `*`, `&`, `|` and the comparisons work lane
by lane on two values of one type. Vectors are LLVM's own, so that the compiler maps each to one, two or four registers
of the processor. No function checks bounds.

numba passes the first parameter of every intrinsic, `typing`; callers leave it out. While numba compiles, the other
parameters of an intrinsic are the types of its arguments.

The tests switch on type checks; `no_type_check` excludes functions that numba calls while it compiles.
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
"""Function that emits LLVM code for an operation: (builder, element type, values…) → resulting value.

The builder is llvmlite's `IRBuilder`; the values are LLVM values, and the element type is numba's.
"""


class Lanes(types.Type):
    """Numba type of a vector of `count` numbers of the scalar type `element`."""

    @no_type_check
    def __init__(self, element, count=LANES):
        self.element, self.count = element, count
        super().__init__(name=f"Lanes({element}, {count})")


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    """Data model of `Lanes` for numba: an LLVM vector, in memory and in registers; truth values have one bit each."""

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
    """Return the type of a vector of truth values with as many lanes as the type `like`."""
    return Lanes(types.boolean, like.count)


@no_type_check
def arithmetic(of_reals: str, of_integers: str) -> Make:
    """Return a function that emits an arithmetic operation on two vectors.

    Args:
        of_reals: name of the method of `IRBuilder` for floating-point elements.
        of_integers: name of the method of `IRBuilder` for integer elements.
    """

    def make(builder, element, x, y):
        return getattr(builder, of_reals if real(element) else of_integers)(x, y)

    return make


@no_type_check
def comparison(sign: str) -> Make:
    """Return a function that emits the comparison `sign` ("<", "==", …) of two vectors, which is false for NaN."""

    def make(builder, element, x, y):
        compare = builder.fcmp_ordered if real(element) else builder.icmp_signed  # False for NaN
        return compare(sign, x, y)

    return make


@no_type_check
def register(operation: Make, make: Make, compares: bool = False) -> None:
    """Register an operator on two vectors with numba: its type, and the function that emits its code.

    Args:
        operation: the operator, such as `operator.add`.
        make: function that emits the code.
        compares: true if the operator returns truth values.
    """

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
    """Emit LLVM code for the smaller number of x and y in each lane, and return its result; y where x is NaN.

    The arguments and the result are those of a `Make`, a function that emits the code of an operation.
    """
    return builder.select(comparison("<")(builder, element, x, y), x, y)


@no_type_check
def most_of(builder, element, x, y):
    """Emit LLVM code for the larger number of x and y in each lane, and return its result; y where x is NaN.

    The arguments and the result are those of a `Make`, a function that emits the code of an operation.
    """
    return builder.select(comparison(">")(builder, element, x, y), x, y)


@no_type_check
def coded(result, arguments, make):
    """Return the signature of an intrinsic and its code generator.

    Args:
        result: type of the result.
        arguments: types of the arguments.
        make: function that emits the code from the builder and the values.
    """

    def generate(context, builder, sig, values):
        return make(builder, *values)

    return result(*arguments), generate


@intrinsic
@no_type_check
def least(typing, a, b):
    """Return the smaller number of a and b in each lane; b if a is NaN.

    Call it as `least(a, b)`; numba passes `typing`.
    """
    return coded(a, (a, b), lambda builder, x, y: least_of(builder, a.element, x, y))


@intrinsic
@no_type_check
def most(typing, a, b):
    """Return the larger number of a and b in each lane; b if a is NaN.

    Call it as `most(a, b)`; numba passes `typing`.
    """
    return coded(a, (a, b), lambda builder, x, y: most_of(builder, a.element, x, y))


@intrinsic
@no_type_check
def where(typing, truth, a, b):
    """Return a in lanes where `truth` is true, and b in the other lanes.

    Call it as `where(truth, a, b)`; numba passes `typing`.
    """
    return coded(a, (truth, a, b), lambda builder, t, x, y: builder.select(t, x, y))


@intrinsic
@no_type_check
def fma(typing, a, b, c):
    """Return a·b + c, rounded once if the processor has a fused multiply-add, otherwise after each step.

    All calls on one machine round in the same way.

    Call it as `fma(a, b, c)`; numba passes `typing`.
    """
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
    """Return a vector with the number in every lane.

    Call it as `splat(number)`; numba passes `typing`.
    """

    def generate(context, builder, sig, values):
        vector = context.get_value_type(sig.return_type)
        empty = ir.Constant(vector, ir.Undefined)
        with_number = builder.insert_element(empty, values[0], ir.Constant(INT32, 0))
        return builder.shuffle_vector(with_number, empty, places([0] * LANES))

    return Lanes(number)(number), generate


@no_type_check
def places(indices):
    """Return a constant vector of the integers `indices`, as LLVM needs it to rearrange lanes."""
    return ir.Constant(ir.VectorType(INT32, len(indices)), indices)


@no_type_check
def folded(vector, combine):
    """Return signature and code generator, as `coded` does, of an intrinsic that reduces a vector to one number.

    Args:
        vector: type of the vector.
        combine: function that emits the code for two numbers.
    """

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
    """Return the smallest number of all lanes.

    Call it as `lowest(vector)`; numba passes `typing`.
    """
    return folded(vector, least_of)


@intrinsic
@no_type_check
def highest(typing, vector):
    """Return the largest number of all lanes.

    Call it as `highest(vector)`; numba passes `typing`.
    """
    return folded(vector, most_of)


@intrinsic
@no_type_check
def total(typing, vector):
    """Return the sum of all lanes.

    Call it as `total(vector)`; numba passes `typing`.
    """
    return folded(vector, arithmetic("fadd", "add"))


@intrinsic
@no_type_check
def bits(typing, truth):
    """Return an int64 whose bit i is lane i of a vector of truth values.

    Call it as `bits(truth)`; numba passes `typing`.
    """

    def make(builder, value):
        return builder.zext(builder.bitcast(value, ir.IntType(truth.count)), ir.IntType(64))

    return coded(types.int64, (truth,), make)


@intrinsic
@no_type_check
def mask(typing, number):
    """Return the 16 lowest bits of an int64 as a vector of truth values.

    Call it as `mask(number)`; numba passes `typing`.
    """

    def make(builder, value):
        return builder.bitcast(builder.trunc(value, ir.IntType(LANES)), ir.VectorType(ir.IntType(1), LANES))

    return coded(Lanes(types.boolean), (number,), make)


@intrinsic
@no_type_check
def first(typing, number):
    """Return the index of the lowest set bit of an int64 that is not 0.

    Call it as `first(number)`; numba passes `typing`.
    """
    return coded(types.int64, (number,), lambda builder, x: builder.cttz(x, ir.Constant(ir.IntType(1), 1)))


@intrinsic
@no_type_check
def how_many(typing, number):
    """Return the number of bits of an int64 that are set.

    Call it as `how_many(number)`; numba passes `typing`.
    """
    return coded(types.int64, (number,), lambda builder, x: builder.ctpop(x))


@intrinsic
@no_type_check
def whole(typing, vector):
    """Return the numbers of a vector rounded towards zero, as int32; they must be in the range of int32.

    Call it as `whole(vector)`; numba passes `typing`.
    """
    result = Lanes(types.int32, vector.count)
    return coded(result, (vector,), lambda builder, x: builder.fptosi(x, ir.VectorType(INT32, vector.count)))


@intrinsic
@no_type_check
def lane(typing, vector, index):
    """Return the number in the lane `index` of a vector.

    Call it as `lane(vector, index)`; numba passes `typing`.
    """
    return coded(vector.element, (vector, types.intp), lambda builder, x, i: builder.extract_element(x, i))


@intrinsic
@no_type_check
def with_id(typing, vector, number):
    """Return `vector`, of four lanes, with the bits of an integer in its last lane.

    The integer is stored as int32 in a float32 vector, and as int64 in a float64 vector.

    Call it as `with_id(vector, number)`; numba passes `typing`.
    """
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
    """Emit code for the address of an array element, and return the address.

    Args:
        context: numba's target context.
        builder: llvmlite's `IRBuilder`.
        sig: signature of the intrinsic, whose first argument is the array.
        values: LLVM values of a contiguous array with one axis, and of the index of the element.
    """
    array = context.make_array(sig.args[0])(context, builder, values[0])
    return builder.gep(array.data, [values[1]])


@intrinsic
@no_type_check
def take(typing, array, index):
    """Return the element of an array at `index`, which must not be negative.

    Call it as `take(array, index)`; numba passes `typing`.
    """

    def generate(context, builder, sig, values):
        return builder.load(pointer(context, builder, sig, values))

    return array.dtype(array, types.intp), generate


@no_type_check
def loaded(array, stride, parts, count=LANES):
    """Return signature and code generator, as `coded` does, of an intrinsic that loads `parts` vectors from an array.

    Vector c holds the elements c, c + stride, c + 2 stride, …, counted from an index that the intrinsic takes.

    Args:
        array: numba type of the array.
        stride: distance of the elements of a vector; with 1, a single vector is returned, not a tuple.
        parts: number of vectors.
        count: number of lanes.
    """
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
    """Return a vector of 16 consecutive elements of an array, from index `start` on.

    Call it as `load(array, start)`; numba passes `typing`.
    """
    return loaded(array, 1, 1)


@intrinsic
@no_type_check
def gather(typing, array, indices, truth):
    """Return the elements of an array at the int64 `indices` in lanes where `truth` is true, and 0 in other lanes.

    Call it as `gather(array, indices, truth)`; numba passes `typing`.
    """
    result = Lanes(array.dtype)

    def generate(context, builder, sig, values):
        element, vector = (context.get_value_type(kind) for kind in (array.dtype, result))
        data = context.make_array(sig.args[0])(context, builder, values[0]).data
        size = ir.Constant(ir.IntType(64), array.dtype.bitwidth // 8)
        wide = ir.VectorType(ir.IntType(64), LANES)
        steps = builder.mul(values[1], ir.Constant(wide, [size.constant] * LANES))
        start = builder.ptrtoint(data, ir.IntType(64))
        same = builder.insert_element(ir.Constant(wide, ir.Undefined), start, ir.Constant(INT32, 0))
        starts = builder.shuffle_vector(same, same, places([0] * LANES))
        pointers = builder.inttoptr(builder.add(starts, steps), ir.VectorType(element.as_pointer(), LANES))
        arguments = [pointers.type, INT32, ir.VectorType(ir.IntType(1), LANES), vector]
        kind = f"f{array.dtype.bitwidth}" if real(array.dtype) else f"i{array.dtype.bitwidth}"
        name = f"llvm.masked.gather.v{LANES}{kind}.v{LANES}p0"
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, arguments), name)
        align = ir.Constant(INT32, array.dtype.bitwidth // 8)
        return builder.call(function, [pointers, align, values[2], ir.Constant(vector, None)])

    return result(array, indices, truth), generate


@intrinsic
@no_type_check
def load4(typing, array, start):
    """Return a vector of 4 consecutive elements of an array, from index `start` on.

    Call it as `load4(array, start)`; numba passes `typing`.
    """
    return loaded(array, 1, 1, 4)


@intrinsic
@no_type_check
def load_triples(typing, array, start):
    """Return vectors x, y, z of 16 points that are stored as x y z x y z … from index `start` on.

    Call it as `load_triples(array, start)`; numba passes `typing`.
    """
    return loaded(array, 3, 3)


@intrinsic
@no_type_check
def load_quadruples(typing, array, start):
    """Return four vectors x, y, z, w of 16 records that are stored as x y z w x y z w … from index `start` on.

    Call it as `load_quadruples(array, start)`; numba passes `typing`.
    """
    return loaded(array, 4, 4)


@intrinsic
@no_type_check
def store(typing, array, start, vector):
    """Write a vector to consecutive elements of an array, from index `start` on.

    Call it as `store(array, start, vector)`; numba passes `typing`.
    """

    def generate(context, builder, sig, values):
        address = pointer(context, builder, sig, values)
        address = builder.bitcast(address, context.get_value_type(vector).as_pointer())
        builder.store(values[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate

"""Explicit vectors for Numba kernels: Python functions that emit LLVM vector code through intrinsics.

A function decorated with ``vector_kernel`` is written once with ordinary operators on ``Vector`` and ``Mask`` and
becomes a function that Numba kernels call with addresses (int64), integers and float32 scalars::

    @vector_kernel("ii")
    def double(v, source, target):
        v.store(v.load(source) * 2, target)

Every vector has ``LANES`` float32 lanes: 16 with AVX-512, 8 otherwise; LLVM splits them further where a machine has
narrower registers. ``NUREC_SIM_SIMD`` (avx512, avx2, plain) overrides the choice. Results are the same bytes for the
same choice, whatever the number of threads; between choices they differ in the last bits.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import config
from numba.extending import intrinsic

SETS = ("avx512", "avx2", "plain")


def _instruction_set() -> str:
    asked = os.environ.get("NUREC_SIM_SIMD", "")
    if asked:
        if asked not in SETS:
            raise ValueError(f"NUREC_SIM_SIMD must be one of {', '.join(SETS)}, got {asked!r}")
        return asked
    other, features_asked = (getattr(config, name, None) for name in ("CPU_NAME", "CPU_FEATURES"))
    if other or features_asked is not None:  # compiling for another machine than this one
        text = f"{other} {features_asked}"
        return "avx2" if "avx2" in text or "haswell" in text else "plain"
    features = binding.get_host_cpu_features()
    if all(features.get(name) for name in ("avx512f", "avx512vl", "avx512bw", "avx512dq")):
        return "avx512"
    return "avx2" if features.get("avx2") and features.get("fma") else "plain"


INSTRUCTION_SET = _instruction_set()
LANES = 16 if INSTRUCTION_SET == "avx512" else 8

F32, I1, I8, I16, I32, I64 = (
    ir.FloatType(),
    ir.IntType(1),
    ir.IntType(8),
    ir.IntType(16),
    ir.IntType(32),
    ir.IntType(64),
)
FLOATS, INTS, BITS = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES), ir.VectorType(I1, LANES)
# Fused multiply-add, reordered sums and reciprocals, but no "nnan" or "ninf": masks rely on comparisons with NaN.
_FAST = ("contract", "reassoc", "nsz", "arcp")
_POINTER = ir.PointerType()

Number = float | int


class Vector:
    """``LANES`` float32 values; numbers in expressions apply to all lanes."""

    __slots__ = ("b", "value")

    def __init__(self, b: ir.IRBuilder, value: ir.Value) -> None:
        self.b, self.value = b, value

    def _of(self, other: Vector | Number) -> ir.Value:
        return other.value if isinstance(other, Vector) else constant(other)

    def __add__(self, other: Vector | Number) -> Vector:
        return Vector(self.b, self.b.fadd(self.value, self._of(other), flags=_FAST))

    def __sub__(self, other: Vector | Number) -> Vector:
        return Vector(self.b, self.b.fsub(self.value, self._of(other), flags=_FAST))

    def __rsub__(self, other: Vector | Number) -> Vector:
        return Vector(self.b, self.b.fsub(self._of(other), self.value, flags=_FAST))

    def __mul__(self, other: Vector | Number) -> Vector:
        return Vector(self.b, self.b.fmul(self.value, self._of(other), flags=_FAST))

    def __truediv__(self, other: Vector | Number) -> Vector:
        return Vector(self.b, self.b.fdiv(self.value, self._of(other), flags=_FAST))

    def __rtruediv__(self, other: Vector | Number) -> Vector:
        return Vector(self.b, self.b.fdiv(self._of(other), self.value, flags=_FAST))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Vector:
        return Vector(self.b, self.b.fneg(self.value))

    def _compare(self, sign: str, other: Vector | Number) -> Mask:
        return Mask(self.b, self.b.fcmp_ordered(sign, self.value, self._of(other)))

    def __lt__(self, other: Vector | Number) -> Mask:
        return self._compare("<", other)

    def __le__(self, other: Vector | Number) -> Mask:
        return self._compare("<=", other)

    def __gt__(self, other: Vector | Number) -> Mask:
        return self._compare(">", other)

    def __ge__(self, other: Vector | Number) -> Mask:
        return self._compare(">=", other)

    def max(self, other: Vector | Number) -> Vector:
        """The larger of each lane; of ``other`` where this is NaN."""
        return (self > other).where(self, other)

    def min(self, other: Vector | Number) -> Vector:
        """The smaller of each lane; of ``other`` where this is NaN."""
        return (self < other).where(self, other)

    def _unary(self, name: str) -> Vector:
        f = declare(self.b, f"llvm.{name}.v{LANES}f32", FLOATS, [FLOATS])
        return Vector(self.b, self.b.call(f, [self.value]))

    def abs(self) -> Vector:
        """Magnitude."""
        return self._unary("fabs")

    def sqrt(self) -> Vector:
        """Square root."""
        return self._unary("sqrt")

    def floor(self) -> Vector:
        """Largest whole number not above."""
        return self._unary("floor")

    def ceil(self) -> Vector:
        """Smallest whole number not below."""
        return self._unary("ceil")

    def reciprocal(self, refined: bool = True) -> Vector:
        """1 / x to about 1e-7, or 6e-5 where that saves work and ``refined`` is False."""
        if INSTRUCTION_SET != "avx512":
            return 1 / self
        f = declare(self.b, "llvm.x86.avx512.rcp14.ps.512", FLOATS, [FLOATS, FLOATS, I16])
        # 14 bits from the table instruction; a Newton step doubles them.
        r = Vector(self.b, self.b.call(f, [self.value, constant(0), ir.Constant(I16, -1)]))
        return r * (2 - self * r) if refined else r

    def integers(self) -> ir.Value:
        """Truncated to int32 lanes (LLVM value)."""
        return self.b.fptosi(self.value, INTS)

    def bits(self) -> ir.Value:
        """The same bits as int32 lanes (LLVM value)."""
        return self.b.bitcast(self.value, INTS)


class Mask:
    """``LANES`` truth values."""

    __slots__ = ("b", "value")

    def __init__(self, b: ir.IRBuilder, value: ir.Value) -> None:
        self.b, self.value = b, value

    def __and__(self, other: Mask) -> Mask:
        return Mask(self.b, self.b.and_(self.value, other.value))

    def __or__(self, other: Mask) -> Mask:
        return Mask(self.b, self.b.or_(self.value, other.value))

    def __invert__(self) -> Mask:
        return Mask(self.b, self.b.not_(self.value))

    def where(self, yes: Vector | Number, no: Vector | Number) -> Vector:
        """``yes`` in true lanes, ``no`` in the others."""
        lanes = [x.value if isinstance(x, Vector) else constant(x) for x in (yes, no)]
        return Vector(self.b, self.b.select(self.value, *lanes))

    def integer(self) -> ir.Value:
        """An int64 whose bit k is lane k."""
        return self.b.zext(self.b.bitcast(self.value, ir.IntType(LANES)), I64)

    def any(self) -> ir.Value:
        """An int64: 1 where any lane is true, else 0."""
        bits = self.b.bitcast(self.value, ir.IntType(LANES))
        return self.b.zext(self.b.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0)), I64)


class Lanes:
    """What a vector kernel's first argument offers: memory, constants, loops."""

    def __init__(self, b: ir.IRBuilder) -> None:
        self.b = b

    def number(self, value: Number) -> Vector:
        """The same number in all lanes."""
        return Vector(self.b, constant(value))

    def numbers(self, values: Sequence[Number]) -> Vector:
        """One constant per lane."""
        return Vector(self.b, ir.Constant(FLOATS, [float(np.float32(x)) for x in values]))

    def index(self) -> Vector:
        """0, 1, 2, ... per lane."""
        return self.numbers(range(LANES))

    def spread(self, scalar: ir.Value) -> Vector:
        """A float32 scalar in all lanes."""
        return Vector(self.b, spread(self.b, scalar, FLOATS))

    def address(self, base: ir.Value, offset: ir.Value | int) -> ir.Value:
        """``base`` + ``offset`` bytes."""
        if isinstance(offset, int):
            return self.b.add(base, ir.Constant(I64, offset)) if offset else base
        return self.b.add(base, offset)

    def pointer(self, base: ir.Value, offset: ir.Value | int = 0) -> ir.Value:
        """The pointer to an address."""
        return self.b.inttoptr(self.address(base, offset), _POINTER)

    def load(self, base: ir.Value, offset: ir.Value | int = 0, align: int = 4) -> Vector:
        """``LANES`` floats from memory; ``offset`` in bytes."""
        return Vector(self.b, self.b.load(self.pointer(base, offset), typ=FLOATS, align=align))

    def store(self, x: Vector, base: ir.Value, offset: ir.Value | int = 0, align: int = 4) -> None:
        """``LANES`` floats to memory.

        Args:
            x: what to store.
            base: address.
            offset: added to the address, in bytes.
            align: alignment of the result in bytes.
        """
        self.b.store(x.value, self.pointer(base, offset), align=align)

    def broadcast(self, base: ir.Value, offset: ir.Value | int = 0) -> Vector:
        """One float from memory in all lanes."""
        return self.spread(self.b.load(self.pointer(base, offset), typ=F32, align=4))

    def table(self, name: str, numbers: Sequence[int]) -> ir.Value:
        """The address (int64) of a table of int64 constants, by a name of its own."""
        kind = ir.ArrayType(I64, len(numbers))
        if name not in self.b.module.globals:
            made = ir.GlobalVariable(self.b.module, kind, name)
            made.global_constant, made.linkage, made.initializer = True, "private", ir.Constant(kind, list(numbers))
        return self.b.ptrtoint(self.b.module.globals[name], I64)

    def gather(self, base: ir.Value, index: ir.Value) -> Vector:
        """``base[index]`` for int32 lanes ``index`` (in floats)."""
        wide, pointers = ir.VectorType(I64, LANES), ir.VectorType(_POINTER, LANES)
        # Byte offsets of float32 entries.
        offsets = self.b.shl(self.b.sext(index, wide), ir.Constant(wide, [2] * LANES))
        where = self.b.inttoptr(self.b.add(spread(self.b, base, wide), offsets), pointers)
        f = declare(self.b, f"llvm.masked.gather.v{LANES}f32.v{LANES}p0", FLOATS, [pointers, I32, BITS, FLOATS])
        everywhere = ir.Constant(BITS, [1] * LANES)
        return Vector(self.b, self.b.call(f, [where, ir.Constant(I32, 4), everywhere, constant(0)]))

    def from_bits(self, lanes: ir.Value) -> Vector:
        """int32 lanes as the floats of the same bits."""
        return Vector(self.b, self.b.bitcast(lanes, FLOATS))

    def from_integers(self, lanes: ir.Value) -> Vector:
        """int32 lanes converted to floats."""
        return Vector(self.b, self.b.sitofp(lanes, FLOATS))

    def transpose(self, rows: Sequence[Vector]) -> list[Vector]:
        """Columns of ``LANES`` rows."""
        assert len(rows) == LANES
        now, step = [row.value for row in rows], LANES // 2
        while step:
            # Swap off-diagonal blocks of ``step`` lanes between rows that lie ``step`` apart.
            low = [k if not k & step else k - step + LANES for k in range(LANES)]
            high = [k + step if not k & step else k + LANES for k in range(LANES)]
            following = list(now)
            for k in range(LANES):
                if not k & step:
                    following[k] = self._shuffle(now[k], now[k + step], low)
                    following[k + step] = self._shuffle(now[k], now[k + step], high)
            now, step = following, step // 2
        return [Vector(self.b, value) for value in now]

    def _shuffle(self, x: ir.Value, y: ir.Value, lanes: Sequence[int]) -> ir.Value:
        return self.b.shuffle_vector(x, y, ir.Constant(INTS, lanes))

    def sums(self, vectors: Sequence[Vector]) -> Vector:
        """A vector whose lane k is the sum over all lanes of ``vectors[k]``, for ``LANES`` vectors."""
        assert len(vectors) == LANES
        now, width = [x.value for x in vectors], LANES
        while width > 1:
            # Each round adds the two halves of every pair of vectors, so LANES vectors become one after log2(LANES)
            # rounds; the order of the sum is fixed.
            half, groups = width // 2, LANES // width
            starts = [side + group * width for side in (0, LANES) for group in range(groups)]
            parts = [[start + h * half + k for start in starts for k in range(half)] for h in range(2)]
            now = [
                self.b.fadd(self._shuffle(x, y, parts[0]), self._shuffle(x, y, parts[1]), flags=_FAST)
                for x, y in zip(now[0::2], now[1::2], strict=True)
            ]
            width = half
        return Vector(self.b, now[0])

    def repeat(
        self, count: ir.Value, state: Sequence[Vector], body: Callable[[ir.Value, list[Vector]], Sequence[Vector]]
    ) -> list[Vector]:
        """Run ``body(i, state)`` for i in 0..count - 1 (at least once), the state kept in registers."""
        if isinstance(count, ir.Constant) and count.constant == 1:
            return list(body(ir.Constant(I64, 0), list(state)))
        b = self.b
        before, start, end = b.block, b.append_basic_block("loop"), b.append_basic_block("done")
        b.branch(start)
        b.position_at_end(start)
        i = b.phi(I64)
        i.add_incoming(ir.Constant(I64, 0), before)
        # A phi node per value is what keeps the state in registers across iterations.
        phis = [b.phi(FLOATS) for _ in state]
        for phi, value in zip(phis, state, strict=True):
            phi.add_incoming(value.value, before)
        after = body(i, [Vector(b, phi) for phi in phis])
        # b.block, not ``start``: the body may itself have added blocks.
        following = b.add(i, ir.Constant(I64, 1))
        i.add_incoming(following, b.block)
        for phi, value in zip(phis, after, strict=True):
            phi.add_incoming(value.value, b.block)
        b.cbranch(b.icmp_signed("<", following, count), start, end)
        b.position_at_end(end)
        return list(after)


def constant(value: Number) -> ir.Constant:
    """A number in all lanes, rounded to float32."""
    return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)


def spread(b: ir.IRBuilder, scalar: ir.Value, vector_type: ir.VectorType) -> ir.Value:
    """A scalar in all lanes of a vector type."""
    nothing = ir.Constant(vector_type, ir.Undefined)
    one = b.insert_element(nothing, scalar, ir.Constant(I32, 0))
    return b.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(I32, vector_type.count), [0] * vector_type.count))


def declare(b: ir.IRBuilder, name: str, result: ir.Type, arguments: Sequence[ir.Type]) -> ir.Function:
    """An LLVM intrinsic by name.

    Args:
        b: builder, whose module declares it.
        name: such as ``llvm.sqrt.v8f32``; an intrinsic declared before is reused.
        result: type of its result.
        arguments: types of its arguments.
    """
    return b.module.globals.get(name) or ir.Function(b.module, ir.FunctionType(result, arguments), name)


_SCALARS = {"i": types.int64, "f": types.float32}


def vector_kernel(arguments: str) -> Callable[[Callable[..., Any]], Any]:
    """Make ``function(v, *arguments)`` callable from Numba kernels.

    Args:
        arguments: a letter per argument, i for int64 (numbers and addresses), f for float32. The function gets LLVM
            values, and may return an int64 value; 0 is returned where it returns None. Arguments with an n, which come
            first, are numbers that are known when it is compiled (``kernel.fixed``); it gets them as Python numbers.
    """
    known = arguments.count("n")

    def decorate(function: Callable[..., Any]) -> Any:
        def typed(*given: Any) -> tuple[Any, Callable[..., Any]]:
            """The signature for arguments of some types, and what emits the call."""
            return types.int64(*given[:known], *[_SCALARS[letter] for letter in arguments[known:]]), generate

        def generate(context: Any, b: ir.IRBuilder, sig: Any, values: Sequence[ir.Value]) -> ir.Value:
            """Emit the call in place.

            Args:
                context: Numba's target context.
                b: builder at the call.
                sig: signature of the call.
                values: LLVM values of the arguments.
            """
            result = function(Lanes(b), *[len(kind) for kind in sig.args[:known]], *values[known:])
            return ir.Constant(I64, 0) if result is None else result

        # Numba matches arguments by position, so the typing function needs exactly as many parameters.
        names = ", ".join(f"a{k}" for k in range(len(arguments)))
        scope: dict[str, Any] = {"typed": typed}
        exec(f"def {function.__name__}(context, {names}):\n    return typed({names})\n", scope)
        return intrinsic(scope[function.__name__])

    return decorate


@vector_kernel("i")
def prefetch(v: Lanes, address: ir.Value) -> None:
    """Ask for the cache line at an address."""
    f = declare(v.b, "llvm.prefetch.p0", ir.VoidType(), [_POINTER, I32, I32, I32])
    v.b.call(f, [v.pointer(address), ir.Constant(I32, 0), ir.Constant(I32, 3), ir.Constant(I32, 1)])

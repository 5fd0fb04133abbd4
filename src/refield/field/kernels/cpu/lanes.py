"""Sixteen rays' way through the occupancy grid at once: `walk.next_sample` in LLVM vectors, so that they run on any
processor.

Rays walk in lanes of one array (ROWS, LANES); what is asked of the grid's tables is asked lane by lane in between.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from refield.field.kernels.cpu.simd import JIT
from refield.field.kernels.cpu.walk import STRETCH

LANES = 16
# Where a ray is, and until where nothing is; length of the lattice's interval there; origin and direction, the latter's
# inverse in cells and that of its fastest component (see `walk.start`); end. Midpoint in cells, its distance from the
# core's centre. What was found there: how many cubes are empty on every side, and how many of them a side of a cell.
T, SAFE, DT, U, V, INVERSE, SPEED, FAR, PLACE, REACH, MANY, FINE, ROWS = 0, 1, 2, 3, 6, 9, 12, 13, 14, 17, 18, 19, 20

_FLOAT, _INT, _LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT, LANES)


class _Vectors:
    """What lanes are computed with, in the words of the loops beside."""

    def __init__(self, builder: Any, lanes: Any) -> None:
        self.builder, self._lanes = builder, lanes

    def row(self, index: int) -> Any:
        at = self.builder.add(self._lanes, ir.Constant(_LONG, 4 * LANES * index))
        return self.builder.inttoptr(at, _FLOATS.as_pointer())

    def load(self, index: int) -> Any:
        return self.builder.load(self.row(index), align=4)

    def store(self, value: Any, index: int) -> None:
        self.builder.store(value, self.row(index), align=4)

    def three(self, index: int) -> list[Any]:
        return [self.load(index + a) for a in range(3)]

    def number(self, value: float) -> Any:
        return ir.Constant(_FLOATS, [float(value)] * LANES)

    def each(self, scalar: Any, kind: Any = _FLOATS) -> Any:
        """A vector that holds a scalar in every lane."""
        one = self.builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_INT, 0))
        return self.builder.shuffle_vector(one, one, ir.Constant(_INTS, [0] * LANES))

    def bits(self, which: Any) -> Any:
        """Of lanes, a bit each."""
        return self.builder.bitcast(which, ir.IntType(LANES))

    def call(self, name: str, value: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS])
        return self.builder.call(
            cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.v{LANES}f32"), [value]
        )

    def less(self, a: Any, b: Any) -> Any:
        return self.builder.fcmp_ordered("<", a, b)

    def least(self, a: Any, b: Any) -> Any:
        return self.builder.select(self.less(a, b), a, b)

    def most(self, a: Any, b: Any) -> Any:
        return self.builder.select(self.less(b, a), a, b)

    def largest(self, xyz: list[Any]) -> Any:
        x, y, z = (self.call("fabs", v) for v in xyz)
        return self.most(x, self.most(y, z))

    def along(self, t: Any) -> list[Any]:
        """The rays' places at t, in core radii."""
        b = self.builder
        return [b.fadd(u, b.fmul(v, t)) for u, v in zip(self.three(U), self.three(V))]

    def interval(self, t: Any, step: Any) -> Any:
        """How long the lattice's interval at t is."""
        b, m, one = self.builder, self.largest(self.along(t)), self.number(1)
        longer = b.fmul(step, b.fmul(m, self.call("sqrt", m)))
        return b.select(self.less(one, m), longer, step)


def _on_lanes(code: Callable[..., Any], *arguments: Any, result: Any = types.void) -> Any:
    """An intrinsic: ``code`` with `_Vectors` of the lanes at an address, and scalars."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        done = code(_Vectors(builder, args[0]), *args[1:])
        return context.get_dummy_value() if result == types.void else done

    return result(types.intp, *arguments), codegen


def _make_stride(typing: Any, lanes: Any, step: Any) -> Any:
    def code(v: _Vectors, step: Any) -> None:
        b, step, safe, t = v.builder, v.each(step), v.load(SAFE), v.load(T)
        entry, loop, done = b.block, b.append_basic_block("stride"), b.append_basic_block("strode")
        b.branch(loop)
        b.position_at_end(loop)
        at = b.phi(_FLOATS)
        at.add_incoming(t, entry)
        dt = v.interval(at, step)
        further = b.fadd(at, dt)
        goes = v.less(further, safe)
        following = b.select(goes, further, at)
        at.add_incoming(following, b.block)
        b.cbranch(b.icmp_unsigned("!=", v.bits(goes), ir.Constant(ir.IntType(LANES), 0)), loop, done)
        b.position_at_end(done)
        v.store(at, T)
        v.store(dt, DT)

    return _on_lanes(code, types.float32)


def _make_look(typing: Any, lanes: Any, near: Any, side: Any) -> Any:
    def code(v: _Vectors, near: Any, side: Any) -> Any:
        b, t, dt, one, two, none = v.builder, v.load(T), v.load(DT), v.number(1), v.number(2), v.number(0)
        places = v.along(b.fadd(t, b.fmul(dt, v.number(0.5))))
        m = v.largest(places)
        v.store(m, REACH)
        beyond = v.most(m, one)
        k = b.fdiv(b.fsub(two, b.fdiv(one, beyond)), beyond)  # 1 within the core
        cells = v.each(b.sitofp(side, _FLOAT))
        last, row, index = b.fsub(cells, one), v.each(side, _INTS), ir.Constant(_INTS, [0] * LANES)
        for a, x in enumerate(places):
            p = b.fmul(b.fadd(b.fmul(x, k), two), b.fmul(cells, v.number(0.25)))
            v.store(p, PLACE + a)
            index = b.add(b.mul(index, row), b.fptosi(v.least(v.most(p, none), last), _INTS))  # never NaN
        empty = ir.Constant(_INTS, [0] * LANES)
        for i in range(LANES):
            at = b.add(near, b.zext(b.extract_element(index, ir.Constant(_INT, i)), _LONG))
            byte = b.load(b.inttoptr(at, ir.IntType(8).as_pointer()))
            empty = b.insert_element(empty, b.zext(byte, _INT), ir.Constant(_INT, i))
        many = b.uitofp(empty, _FLOATS)
        v.store(many, MANY)
        v.store(one, FINE)
        on = v.less(t, v.load(FAR))
        return b.zext(v.bits(b.or_(b.not_(on), b.not_(v.less(none, many)))), _LONG)

    return _on_lanes(code, types.intp, types.int32, result=types.int64)


def _make_leap(typing: Any, lanes: Any, step: Any, stretch: Any) -> Any:
    def code(v: _Vectors, step: Any, stretch: Any) -> None:
        b, one, none = v.builder, v.number(1), v.number(0)
        step, t, dt, m, speed = v.each(step), v.load(T), v.load(DT), v.load(REACH), v.load(SPEED)
        fine, many = v.load(FINE), v.load(MANY)
        size, clear = b.fdiv(one, fine), b.fmul(b.fsub(one, m), speed)
        for p, inverse in zip(v.three(PLACE), v.three(INVERSE)):
            cube = v.call("floor", b.fmul(p, fine))
            ahead, behind = b.fadd(cube, many), b.fsub(b.fadd(cube, one), many)
            edge = b.fmul(size, b.select(v.less(none, inverse), ahead, behind))
            clear = v.least(clear, b.fmul(b.fsub(edge, p), inverse))
        # lattice midpoints in what is empty are skipped; a hair is kept back for rounding
        skip = v.call("floor", b.fsub(b.fdiv(clear, step), v.number(1e-3)))
        inside = v.less(m, one)
        skipped = b.select(inside, b.fmul(v.most(skip, none), step), none)
        # outside the core the lattice has to be walked, but without a look at the grid
        safe = b.fadd(t, b.fmul(b.fmul(b.fsub(many, one), v.each(stretch)), speed))
        v.store(b.select(inside, t, v.least(safe, v.load(FAR))), SAFE)
        v.store(b.fadd(b.fadd(t, skipped), dt), T)

    return _on_lanes(code, types.float32, types.float32)


_stride: Any = intrinsic(_make_stride)
"""Rays go on through the lattice to the last place from which an interval is not all before SAFE; sets T and DT."""
_look: Any = intrinsic(_make_look)
"""Where the interval's midpoint is and what `cells.reach` says there: sets PLACE, REACH, MANY and FINE; returns a bit
for each lane that has come to its end, or to a cell that may hold something."""
_leap: Any = intrinsic(_make_leap)
"""Rays go on by what MANY and FINE say is empty; sets T and SAFE."""


@njit(forceinline=True, **JIT)
def _enter(lanes, i, line, t, far):  # type: ignore[no-untyped-def]
    """A ray, as `walk.start` leaves it, into lane i."""
    lanes[T, i], lanes[SAFE, i], lanes[FAR, i], lanes[SPEED, i] = t, np.float32(-1), far, line[9]
    for a in range(9):
        lanes[U + a, i] = line[a]


@njit(forceinline=True, **JIT)
def _place(lanes, i, per, last):  # type: ignore[no-untyped-def]
    """The numbers of what holds lane i's midpoint along each axis, of ``per`` a cell."""
    most, none = np.float32(last), np.float32(0)
    return (
        int(min(max(lanes[PLACE, i] * per, none), most)),
        int(min(max(lanes[PLACE + 1, i] * per, none), most)),
        int(min(max(lanes[PLACE + 2, i] * per, none), most)),
    )


@njit(forceinline=True, **JIT)
def _found(lanes, i, side, fine, gone):  # type: ignore[no-untyped-def]
    """Whether there is a sample in the cell to which lane i has come; if not, MANY and FINE say what is empty."""
    four = np.float32(4)
    if len(fine) > 0:
        x, y, z = _place(lanes, i, four, 4 * side - 1)
        mask = fine[x >> 2, y >> 2, z >> 2]
        if mask != 0 and (mask >> (((x & 3) * 4 + (y & 3)) * 4 + (z & 3))) & 1 == 0:
            lanes[MANY, i], lanes[FINE, i] = np.float32(1), four
            return False
    if len(gone) > 0:
        n = gone.shape[0]
        per = np.float32(n) / np.float32(side)
        x, y, z = _place(lanes, i, per, n - 1)
        return gone[x, y, z] == 0  # else one step on
    return True


@njit(**JIT)
def next_samples(alive, lines, t, far, step, grids, gone, lanes, out):  # type: ignore[no-untyped-def]
    """The next sample of each ray in ``alive``, of what `walk.next_sample` finds, and not in a cell of ``gone``.

    ``t`` goes behind it; ``out`` takes begin, end, ray and midpoint in [0, 1] of as many as there are, which is
    returned; their rays come to the front of ``alive``.
    """
    near, fine = grids
    side, address = len(near), lanes.ctypes.data
    holds, free = np.full(LANES, -1, np.int64), np.arange(LANES)
    entered, found, frees = 0, 0, LANES
    while entered < len(alive) or frees < LANES:
        while frees > 0 and entered < len(alive):
            frees -= 1
            i, q = free[frees], alive[entered]
            holds[i] = q
            _enter(lanes, i, lines[q], t[q], far[q])
            entered += 1
        _stride(address, step)
        asks = _look(address, near.ctypes.data, np.int32(side))
        if asks != 0:
            for i in range(LANES):
                q = holds[i]
                if (asks >> i) & 1 == 0 or q < 0:
                    continue
                there = lanes[T, i] < lanes[FAR, i]
                if there and not _found(lanes, i, side, fine, gone):
                    continue
                t[q] = lanes[T, i]
                if there:
                    t[q] = _told(lanes, i, q, side, found, out)
                    alive[found] = q  # no more have been found than have been taken from there
                    found += 1
                lanes[FAR, i] = np.float32(-1)  # stands still
                holds[i], free[frees] = -1, i
                frees += 1
        _leap(address, step, STRETCH / np.float32(side / 4))
    return found


@njit(forceinline=True, **JIT)
def _told(lanes, i, q, side, found, out):  # type: ignore[no-untyped-def]
    """Write lane i's sample, of ray q; returns its end."""
    t0, t1, owner, unit = out
    t0[found], t1[found], owner[found] = lanes[T, i], lanes[T, i] + lanes[DT, i], q
    for a in range(3):
        unit[found, a] = lanes[PLACE + a, i] / np.float32(side)
    return t1[found]


@njit(**JIT)
def new_lanes():  # type: ignore[no-untyped-def]
    """Empty lanes: rays that stand still."""
    lanes = np.zeros((ROWS, LANES), np.float32)
    lanes[SAFE], lanes[FAR], lanes[FINE] = np.float32(-1), np.float32(-1), np.float32(1)
    return lanes

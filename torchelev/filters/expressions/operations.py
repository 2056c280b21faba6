"""The functions and operators of formulas, on values and on masks of where the values are valid."""

from __future__ import annotations

import ast
import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchelev.ops.masks import where_finite

Value = tuple[Tensor, Tensor]  # finite numbers, and a mask of which are valid


def _checked(number: Tensor, valid: Tensor) -> Value:
    """Return a result; numbers that overflowed become invalid, with a derivative of 0."""
    return number.nan_to_num(0.0, 0.0, 0.0), valid & (number.abs() <= torch.finfo(number.dtype).max)


def _tiny(number: Tensor) -> float:
    """Return the size below which a divisor counts as 0, 3e-10 in float32, so that derivatives stay finite."""
    return torch.finfo(number.dtype).tiny ** 0.25


# Where a function has no result or no finite derivative, it gets a harmless argument, and its result is replaced.


def _add(a: Value, b: Value) -> Value:
    return _checked(a[0] + b[0], a[1] & b[1])


def _subtract(a: Value, b: Value) -> Value:
    return _checked(a[0] - b[0], a[1] & b[1])


def _multiply(a: Value, b: Value) -> Value:
    return _checked(a[0] * b[0], a[1] & b[1])


def _divide(a: Value, b: Value) -> Value:
    is_valid = (b[0].abs() > _tiny(b[0])) & (a[0].abs() < _tiny(a[0]) * torch.finfo(a[0].dtype).max)
    quotient = where_finite(is_valid, a[0], 0.0) / where_finite(is_valid, b[0], 1.0)
    return quotient, a[1] & b[1] & is_valid


def divide_by(divisor: float) -> Callable[[Value], Value]:
    """Return the division by a literal number; by 0 nothing is valid."""

    def divide(a: Value) -> Value:
        invalid = torch.zeros_like(a[0]), torch.zeros_like(a[1])
        return _checked(a[0] / divisor, a[1]) if divisor else invalid

    return divide


def power(a: Value, b: Value) -> Value:
    """Return a^b = exp(b log a) for a > 0, and 0^b = 0 for b > 0."""
    smallest = torch.where(b[0] > 0, torch.finfo(a[0].dtype).tiny, _tiny(a[0]))
    is_positive, is_zero = a[0] > smallest, a[0].abs() <= torch.finfo(a[0].dtype).tiny
    base = where_finite(is_positive, a[0], 1.0)
    fits = is_positive & (b[0] * base.detach().log() < _largest_exponent(base))
    number = where_finite(fits, base, 1.0) ** where_finite(fits, b[0], 1.0)
    return where_finite(fits, number, 0.0), a[1] & b[1] & (fits | (is_zero & (b[0] > 0)))


def _largest_exponent(number: Tensor) -> float:
    return math.log(torch.finfo(number.dtype).max) - 1


def whole_power(exponent: int) -> Callable[[Value], Value]:
    """Return the power by a literal whole number, valid for negative bases too; 0^0 = 1."""

    def raise_to_power(a: Value) -> Value:
        size, info = a[0].abs(), torch.finfo(a[0].dtype)
        if exponent < 0:
            is_valid = size > info.tiny ** (0.5 / (1 - exponent))
        else:
            is_valid = size < info.max ** (0.99 / max(1, exponent))
        return where_finite(is_valid, a[0], 1.0) ** exponent, a[1] & is_valid

    return raise_to_power


def _sqrt(a: Value) -> Value:
    is_positive = a[0] >= torch.finfo(a[0].dtype).tiny
    return where_finite(is_positive, where_finite(is_positive, a[0], 1.0).sqrt(), 0.0), a[1] & (a[0] >= 0)


def _log(a: Value) -> Value:
    is_positive = a[0] >= torch.finfo(a[0].dtype).tiny
    return where_finite(is_positive, a[0], 1.0).log(), a[1] & is_positive


def _exp(a: Value) -> Value:
    is_valid = a[0] < _largest_exponent(a[0])
    return where_finite(is_valid, a[0], 0.0).exp(), a[1] & is_valid


def _atan2(y: Value, x: Value) -> Value:
    """Return the angle of (x, y), 0 at the origin as in C."""
    is_origin = torch.maximum(y[0].abs(), x[0].abs()) <= _tiny(y[0])
    angle = torch.atan2(where_finite(~is_origin, y[0], 0.0), where_finite(~is_origin, x[0], 1.0))
    return angle, y[1] & x[1]


def _reduced(function: Callable[[Tensor, Tensor], Tensor]) -> Callable[..., Value]:
    """Extend a function of two numbers to several."""

    def reduce(*values: Value) -> Value:
        numbers, valid = zip(*values, strict=True)
        return functools.reduce(function, numbers), functools.reduce(operator.and_, valid)

    return reduce


def _total(function: Callable[[Tensor], Tensor]) -> Callable[[Value], Value]:
    """Lift a function that has a result and a derivative everywhere."""
    return lambda a: (function(a[0]), a[1])


def _clamp(a: Value, low: Value, high: Value) -> Value:
    number = torch.minimum(torch.maximum(a[0], low[0]), high[0])
    return number, a[1] & low[1] & high[1]


def _where(condition: Value, a: Value, b: Value) -> Value:
    """Choose by a condition; only the chosen branch must be valid."""
    is_true = condition[0] != 0
    return torch.where(is_true, a[0], b[0]), condition[1] & torch.where(is_true, a[1], b[1])


def _compare(function: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Value, Value], Value]:
    """Lift a comparison: 1 where it holds, else 0."""
    return lambda a, b: (function(a[0], b[0]).to(a[0].dtype), a[1] & b[1])


def chain(comparisons: Sequence[Callable[[Value, Value], Value]], values: Sequence[Value]) -> Value:
    """Evaluate a chained comparison such as a < b <= c: 1 where each part holds, else 0."""
    results = [compare(*pair) for compare, pair in zip(comparisons, itertools.pairwise(values), strict=True)]
    return functools.reduce(_multiply, results)


_MANY = 1000
FUNCTIONS: dict[str, tuple[Callable[..., Value], int, int]] = {  # with their minimum and maximum number of arguments
    "min": (_reduced(torch.minimum), 2, _MANY),
    "max": (_reduced(torch.maximum), 2, _MANY),
    "abs": (_total(torch.abs), 1, 1),
    "sqrt": (_sqrt, 1, 1),
    "exp": (_exp, 1, 1),
    "log": (_log, 1, 1),
    "sin": (_total(torch.sin), 1, 1),
    "cos": (_total(torch.cos), 1, 1),
    "atan2": (_atan2, 2, 2),
    "clamp": (_clamp, 3, 3),
    "where": (_where, 3, 3),
}
OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: _add,
    ast.Sub: _subtract,
    ast.Mult: _multiply,
    ast.Div: _divide,
    ast.Pow: power,
}
SIGNS: dict[type[ast.unaryop], Callable[[Value], Value]] = {ast.USub: _total(torch.neg), ast.UAdd: _total(torch.clone)}
COMPARISONS: dict[type[ast.cmpop], Callable[[Value, Value], Value]] = {
    ast.Lt: _compare(torch.lt),
    ast.LtE: _compare(torch.le),
    ast.Gt: _compare(torch.gt),
    ast.GtE: _compare(torch.ge),
    ast.Eq: _compare(torch.eq),
    ast.NotEq: _compare(torch.ne),
}

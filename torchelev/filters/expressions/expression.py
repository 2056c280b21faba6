"""A new layer from a formula over layers: `Expression("0.5 * (1 - slope / 0.6) + 0.5 * (1 - roughness / 0.1)")`.

A formula is read by Python's parser and translated, node by node, into functions of tensors: what is not listed here
is refused, and nothing is ever evaluated as Python.
"""

from __future__ import annotations

import ast
import functools
import operator
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from torch import Tensor

from torchelev.errors import message, require
from torchelev.filters.expressions.operations import (
    COMPARISONS,
    FUNCTIONS,
    OPERATORS,
    SIGNS,
    Value,
    chain,
    divide_by,
    only,
    power,
    whole_power,
)
from torchelev.filters.registry import check_layers, masked, register
from torchelev.layers import Layer

MAX_LENGTH = 1000  # characters
MAX_DEPTH = 100  # operations in one another
MAX_NUMBER = 1e30
MAX_EXPONENT = 20

Term = Callable[[dict[str, Tensor], Value], Value]  # from the layers' values, and a scalar 0 that is valid

GRAMMAR = (
    f"there are numbers, layers, + - * / **, comparisons, parentheses and the functions {', '.join(sorted(FUNCTIONS))}"
)


class Expression:
    """A formula over layers, checked when it is made.

    Numbers, layers by their names, + - * / ** and comparisons (1 or 0) as in Python, and the functions min, max, abs,
    sqrt, exp, log, sin, cos, atan2(y, x), clamp(x, low, high), where(condition, x, y). `names` are the layers it reads.

    The result is unknown where one of these layers is unknown, and where it is no finite number: x / 0, log(0),
    sqrt(-1), 0 ** -1, (-1) ** 0.5, exp(1000). Of `where` only the branch that is taken counts, so that
    where(x > 0, 1 / x, 0) is known everywhere. Of a negative number, only powers by a whole number that is written out
    (x ** 3, x ** -2) are known. Derivatives are 0 where a function has none (sqrt at 0).

    Raises ValueError for anything else, naming the place, and, if `available` are the layers that exist, for a layer
    that does not.
    """

    def __init__(self, formula: str, available: Iterable[str] | None = None) -> None:
        self.formula = formula.strip() if isinstance(formula, str) else formula
        self._available = None if available is None else tuple(available)
        translator = _Translator(self.formula, self._available)
        self._term = translator.term(_parse(self.formula))
        self.names = tuple(translator.names)
        require(len(self.names) > 0, "formula", "must read a layer", repr(formula), "name one")

    def __call__(self, layers: Mapping[str, Layer]) -> Layer:
        """Compute the new layer (B, H, W). Raises ValueError for a layer that is missing or has another shape."""
        missing = [name for name in self.names if name not in layers]
        rule, there = f"needs {', '.join(missing)}", ", ".join(sorted(layers)) or "no layer"
        require(not missing, f"formula {self.formula!r}", rule, there, "give layers by these names")
        given = tuple(layers[name] for name in self.names)
        check_layers("formula", given)
        read = [masked(layer) for layer in given]
        known = functools.reduce(operator.and_, (mask for _, mask in read))
        values = {name: numbers for name, (numbers, _) in zip(self.names, read, strict=True)}
        like = read[0][0]
        number, valid = self._term(values, (like.new_zeros(()), known.new_ones(())))
        known = known & valid
        return only(known, number, 0.0), known

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.formula, self._available)

    def __repr__(self) -> str:
        return f"Expression({self.formula!r})"


_kept = functools.lru_cache(maxsize=128)(Expression)


@register
def expression(*layers: Layer, formula: str) -> Layer:
    """Compute a layer from a formula, see `Expression`. The layers come in the order of the formula's `names`."""
    read = _kept(formula)
    wanted = f"takes the layers {', '.join(read.names)}"
    require(len(layers) == len(read.names), f"formula {formula!r}", wanted, len(layers), "give them in this order")
    return read(dict(zip(read.names, layers, strict=True)))


def _parse(formula: str) -> ast.expr:
    """Return the syntax tree of a formula of a bounded size."""
    text = isinstance(formula, str) and len(formula) > 0
    require(text, "formula", "must be text", repr(formula), "give a formula such as '1 - slope / 0.6'")
    short = len(formula) <= MAX_LENGTH
    require(short, "formula", f"must have at most {MAX_LENGTH} characters", len(formula), "split it into layers")
    try:
        return ast.parse(formula, mode="eval").body
    except SyntaxError as error:
        raise _error(formula, f"cannot be read, {error.msg}", error.offset or 1) from None
    except (ValueError, RecursionError, MemoryError) as error:  # null bytes, and many brackets or signs
        raise _error(formula, f"cannot be read, {error or 'nested too deeply'}", 1) from None


def _error(formula: str, rule: str, column: int, hint: str = GRAMMAR) -> ValueError:
    return ValueError(message(f"formula, column {column}", rule, repr(formula), hint))


class _Translator:
    """Makes functions of syntax trees, and notes the layers they read in the order of their first mention."""

    def __init__(self, formula: str, available: tuple[str, ...] | None) -> None:
        self.formula, self.available = formula, available
        self.names: dict[str, None] = {}

    def refused(self, node: ast.AST, rule: str, hint: str = GRAMMAR) -> ValueError:
        """Return the error for a node."""
        return _error(self.formula, rule, getattr(node, "col_offset", 0) + 1, hint)

    def text(self, node: ast.expr) -> str:
        """Return the part of the formula that became a node."""
        return ast.get_source_segment(self.formula, node) or ""

    def term(self, node: ast.expr, depth: int = 0) -> Term:
        """Translate a node and what it holds."""
        if depth > MAX_DEPTH:
            raise self.refused(node, f"must hold at most {MAX_DEPTH} operations in one another", "split it into layers")
        if isinstance(node, ast.Constant):
            return _constant(self.number(node))
        if isinstance(node, ast.Name):
            return self.layer(node)
        function, arguments = self.operation(node)
        terms = [self.term(argument, depth + 1) for argument in arguments]
        return lambda layers, unit: function(*(term(layers, unit) for term in terms))

    def number(self, node: ast.Constant) -> float:
        """Return a number that is written out."""
        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refused(node, f"must not hold {value!r}")
        if not abs(value) <= MAX_NUMBER:
            raise self.refused(node, f"must not hold numbers above {MAX_NUMBER:g}", "use another unit")
        return float(value)

    def layer(self, node: ast.Name) -> Term:
        """Read a layer."""
        name = node.id
        if self.available is not None and name not in self.available:
            there = f"there are {', '.join(sorted(self.available)) or 'none'}"
            raise self.refused(node, f"there is no layer {name!r}", there)
        self.names[name] = None
        return lambda layers, unit: (layers[name], unit[1])

    def operation(self, node: ast.expr) -> tuple[Callable[..., Value], list[ast.expr]]:
        """Return an operation and what it works on."""
        if isinstance(node, ast.Call):
            return self.call(node)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            return self.power(node)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div) and isinstance(node.right, ast.Constant):
            return divide_by(self.number(node.right)), [node.left]
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return OPERATORS[type(node.op)], [node.left, node.right]
        if isinstance(node, ast.UnaryOp) and type(node.op) in SIGNS:
            return SIGNS[type(node.op)], [node.operand]
        if isinstance(node, ast.Compare) and all(type(op) in COMPARISONS for op in node.ops):
            functions = [COMPARISONS[type(op)] for op in node.ops]
            return lambda *values: chain(functions, values), [node.left, *node.comparators]
        raise self.refused(node, f"must not hold {self.text(node)!r}")

    def call(self, node: ast.Call) -> tuple[Callable[..., Value], list[ast.expr]]:
        """Return a function and its arguments."""
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in FUNCTIONS:
            raise self.refused(node, f"there is no function {self.text(node.func)!r}")
        function, least, most = FUNCTIONS[name]
        plain = not node.keywords and not any(isinstance(argument, ast.Starred) for argument in node.args)
        if not plain or not least <= len(node.args) <= most:
            takes = f"{least}" if least == most else f"{least} or more"
            raise self.refused(node, f"{name} takes {takes} arguments", "give them in order, without names")
        return function, node.args

    def power(self, node: ast.BinOp) -> tuple[Callable[..., Value], list[ast.expr]]:
        """Return a power; whole exponents that are written out are a function of their own."""
        negative = isinstance(node.right, ast.UnaryOp) and isinstance(node.right.op, ast.USub)
        written = node.right.operand if isinstance(node.right, ast.UnaryOp) and negative else node.right
        if not isinstance(written, ast.Constant):
            return power, [node.left, node.right]
        exponent = self.number(written) * (-1 if negative else 1)
        if abs(exponent) > MAX_EXPONENT:
            raise self.refused(node.right, f"must not hold exponents above {MAX_EXPONENT}", "use exp")
        return (whole_power(int(exponent)), [node.left]) if exponent.is_integer() else (power, [node.left, node.right])


def _constant(number: float) -> Term:
    return lambda layers, unit: (unit[0].new_full((), number), unit[1])

"""A new layer from a formula over layers: `Expression("0.5 * (1 - slope / 0.6) + 0.5 * (1 - roughness / 0.1)")`.

Python's parser reads the formula, and each node of the syntax tree is translated into a function of tensors. Nodes that
are not listed here are refused; nothing is ever evaluated as Python.
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
    power,
    whole_power,
)
from torchelev.filters.layer_tools import check_layers, zero_unknown
from torchelev.filters.registry import register
from torchelev.layers import Layer
from torchelev.ops.masks import where_finite

_MAX_LENGTH = 1000  # characters
_MAX_DEPTH = 100  # nested operations
_MAX_NUMBER = 1e30
_MAX_EXPONENT = 20

_Term = Callable[[dict[str, Tensor], Value], Value]  # of the layers' values, and a valid scalar 0

_GRAMMAR = (
    f"there are numbers, layers, + - * / **, comparisons, parentheses and the functions {', '.join(sorted(FUNCTIONS))}"
)


class Expression:
    """A formula over layers, checked when it is built.

    The language: numbers, layers by name, + - * / ** and comparisons (1 or 0) as in Python, and the functions min, max,
    abs, sqrt, exp, log, sin, cos, atan2(y, x), clamp(x, low, high), where(condition, x, y). `names` lists the layers
    that the formula reads.

    The result is unknown where one of these layers is unknown, and where it is not a finite number: x / 0, log(0),
    sqrt(-1), 0 ** -1, (-1) ** 0.5, exp(1000). Of `where` only the chosen branch counts, so that
    where(x > 0, 1 / x, 0) is known everywhere. Powers of negative numbers are known for literal whole exponents only
    (x ** 3, x ** -2). Derivatives are 0 where a function has none (sqrt at 0).

    Args:
        formula: the text.
        available: names of the layers that exist; None: any.

    Raises:
        ValueError: if the formula holds anything else or an unavailable layer, naming the column.
    """

    def __init__(self, formula: str, available: Iterable[str] | None = None) -> None:
        self.formula = formula.strip() if isinstance(formula, str) else formula
        self._available = None if available is None else tuple(available)
        translator = _Translator(self.formula, self._available)
        self._term = translator.term(_parse(self.formula))
        self.names = tuple(translator.names)
        require(len(self.names) > 0, "formula", "must read a layer", repr(formula), "name one")

    def __call__(self, layers: Mapping[str, Layer]) -> Layer:
        """Compute the new layer.

        Args:
            layers: by name, (B, H, W) each; further ones are ignored.

        Raises:
            ValueError: if a layer is missing or has another shape.
        """
        missing = [name for name in self.names if name not in layers]
        rule, actual = f"needs {', '.join(missing)}", ", ".join(sorted(layers)) or "no layer"
        require(not missing, f"formula {self.formula!r}", rule, actual, "give layers by these names")
        given = tuple(layers[name] for name in self.names)
        check_layers("formula", given)
        cleaned = [zero_unknown(layer) for layer in given]
        known = functools.reduce(operator.and_, (mask for _, mask in cleaned))
        values = {name: numbers for name, (numbers, _) in zip(self.names, cleaned, strict=True)}
        like = cleaned[0][0]
        number, valid = self._term(values, (like.new_zeros(()), known.new_ones(())))
        known = known & valid
        return where_finite(known, number, 0.0), known

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.formula, self._available)

    def __repr__(self) -> str:
        return f"Expression({self.formula!r})"


_cached = functools.lru_cache(maxsize=128)(Expression)


@register
def expression(*layers: Layer, formula: str) -> Layer:
    """Compute a layer from a formula, see `Expression`.

    Args:
        *layers: in the order in which the formula first names them.
        formula: the text.

    Raises:
        ValueError: if the formula is not valid, or the number of layers differs.
    """
    compiled = _cached(formula)
    rule = f"takes the layers {', '.join(compiled.names)}"
    require(len(layers) == len(compiled.names), f"formula {formula!r}", rule, len(layers), "give them in this order")
    return compiled(dict(zip(compiled.names, layers, strict=True)))


def _parse(formula: str) -> ast.expr:
    """Return the syntax tree of a formula of limited length."""
    is_text = isinstance(formula, str) and len(formula) > 0
    require(is_text, "formula", "must be text", repr(formula), "give a formula such as '1 - slope / 0.6'")
    is_short = len(formula) <= _MAX_LENGTH
    require(is_short, "formula", f"must have at most {_MAX_LENGTH} characters", len(formula), "split it into layers")
    try:
        return ast.parse(formula, mode="eval").body
    except SyntaxError as error:
        raise _error(formula, f"cannot be read, {error.msg}", error.offset or 1) from None
    except (ValueError, RecursionError, MemoryError) as error:  # null bytes, and too many brackets or signs
        raise _error(formula, f"cannot be read, {error or 'nested too deeply'}", 1) from None


def _error(formula: str, rule: str, column: int, hint: str = _GRAMMAR) -> ValueError:
    return ValueError(message(f"formula, column {column}", rule, repr(formula), hint))


class _Translator:
    """Turns syntax trees into functions, and collects the names of layers in the order of their first mention."""

    def __init__(self, formula: str, available: tuple[str, ...] | None) -> None:
        self.formula, self.available = formula, available
        self.names: dict[str, None] = {}

    def error(self, node: ast.AST, rule: str, hint: str = _GRAMMAR) -> ValueError:
        """Return the error for a node."""
        return _error(self.formula, rule, getattr(node, "col_offset", 0) + 1, hint)

    def text(self, node: ast.expr) -> str:
        """Return the formula's text of a node."""
        return ast.get_source_segment(self.formula, node) or ""

    def term(self, node: ast.expr, depth: int = 0) -> _Term:
        """Translate a node and its children."""
        if depth > _MAX_DEPTH:
            raise self.error(node, f"must nest at most {_MAX_DEPTH} operations", "split it into layers")
        if isinstance(node, ast.Constant):
            return _constant(self.number(node))
        if isinstance(node, ast.Name):
            return self.layer(node)
        function, arguments = self.operation(node)
        terms = [self.term(argument, depth + 1) for argument in arguments]
        return lambda layers, unit: function(*(term(layers, unit) for term in terms))

    def number(self, node: ast.Constant) -> float:
        """Return a literal number."""
        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(node, f"must not hold {value!r}")
        if not abs(value) <= _MAX_NUMBER:
            raise self.error(node, f"must not hold numbers above {_MAX_NUMBER:g}", "use another unit")
        return float(value)

    def layer(self, node: ast.Name) -> _Term:
        """Translate the name of a layer."""
        name = node.id
        if self.available is not None and name not in self.available:
            hint = f"there are {', '.join(sorted(self.available)) or 'none'}"
            raise self.error(node, f"there is no layer {name!r}", hint)
        self.names[name] = None
        return lambda layers, unit: (layers[name], unit[1])

    def operation(self, node: ast.expr) -> tuple[Callable[..., Value], list[ast.expr]]:
        """Return a node's operation and operands."""
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
        raise self.error(node, f"must not hold {self.text(node)!r}")

    def call(self, node: ast.Call) -> tuple[Callable[..., Value], list[ast.expr]]:
        """Return a function and its arguments."""
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in FUNCTIONS:
            raise self.error(node, f"there is no function {self.text(node.func)!r}")
        function, min_count, max_count = FUNCTIONS[name]
        is_plain = not node.keywords and not any(isinstance(argument, ast.Starred) for argument in node.args)
        if not is_plain or not min_count <= len(node.args) <= max_count:
            count = f"{min_count}" if min_count == max_count else f"{min_count} or more"
            raise self.error(node, f"{name} takes {count} arguments", "give them in order, without names")
        return function, node.args

    def power(self, node: ast.BinOp) -> tuple[Callable[..., Value], list[ast.expr]]:
        """Return a power and its operands; a literal whole exponent becomes part of the function."""
        is_negative = isinstance(node.right, ast.UnaryOp) and isinstance(node.right.op, ast.USub)
        literal = node.right.operand if isinstance(node.right, ast.UnaryOp) and is_negative else node.right
        if not isinstance(literal, ast.Constant):
            return power, [node.left, node.right]
        exponent = self.number(literal) * (-1 if is_negative else 1)
        if abs(exponent) > _MAX_EXPONENT:
            raise self.error(node.right, f"must not hold exponents above {_MAX_EXPONENT}", "use exp")
        return (whole_power(int(exponent)), [node.left]) if exponent.is_integer() else (power, [node.left, node.right])


def _constant(number: float) -> _Term:
    return lambda layers, unit: (unit[0].new_full((), number), unit[1])

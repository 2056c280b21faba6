"""Formulas over layers, against NumPy and by hand."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchelev.filters.expressions.expression import Expression, expression
from torchelev.filters.registry import FILTERS, Filter

SEEDS = st.integers(0, 10_000)


# Formulas over a, b and c within -2 and 2, and what NumPy makes of them: NaN or inf stand for unknown.
FORMULAS = {
    "a": lambda a, b, c: a,
    "a + 2 * b - c / 4": lambda a, b, c: a + 2 * b - c / 4,
    "-(a - b) + +c": lambda a, b, c: -(a - b) + c,
    "a / b": lambda a, b, c: a / b,
    "1 / (a - a)": lambda a, b, c: 1 / (a - a),
    "a ** 2 + b ** 3": lambda a, b, c: a**2 + b**3,
    "a ** -2": lambda a, b, c: a**-2,
    "a ** 0 + b ** 1": lambda a, b, c: a**0 + b,
    "a ** 0.5": lambda a, b, c: a**0.5,
    "abs(a) ** b": lambda a, b, c: np.abs(a) ** b,
    "2 ** a": lambda a, b, c: 2.0**a,
    "-a ** 2": lambda a, b, c: -(a**2),
    "2 ** 3 ** 2 * a": lambda a, b, c: 512 * a,
    "min(a, b)": lambda a, b, c: np.minimum(a, b),
    "max(a, b, c, 0.5)": lambda a, b, c: np.maximum(np.maximum(a, b), np.maximum(c, 0.5)),
    "abs(a) + sqrt(b)": lambda a, b, c: np.abs(a) + np.sqrt(b),
    "exp(a) - log(b)": lambda a, b, c: np.exp(a) - np.log(b),
    "sin(a) * cos(b)": lambda a, b, c: np.sin(a) * np.cos(b),
    "atan2(a, b)": lambda a, b, c: np.arctan2(a, b),
    "clamp(a, -0.5, b)": lambda a, b, c: np.minimum(np.maximum(a, -0.5), b),
    "where(a > 0, b, c)": lambda a, b, c: np.where(a > 0, b, c),
    "where(a > 0, sqrt(a), 1 / b)": lambda a, b, c: np.where(a > 0, np.sqrt(np.maximum(a, 0)), 1 / b),
    "(a < b) + (a <= b) * 2 + (a == b)": lambda a, b, c: (a < b) + (a <= b) * 2.0 + (a == b),
    "(a > b) - (a >= b) + (a != b)": lambda a, b, c: 1.0 * (a > b) - (a >= b) + (a != b),
    "-1 < a <= b < 1": lambda a, b, c: 1.0 * ((-1 < a) & (a <= b) & (b < 1)),
    "0.5 * (1 - a / 0.6) + 0.5 * (1 - b / 0.1)": lambda a, b, c: 0.5 * (1 - a / 0.6) + 0.5 * (1 - b / 0.1),
}


def random_layers(seed, shape=(2, 5, 4), share=0.8):
    """Numbers within -2 and 2, some of them 0, some equal."""
    rng = np.random.default_rng(seed)
    layers = {}
    for name in "abc":
        values = np.where(rng.uniform(size=shape) < 0.3, rng.integers(-2, 3, shape), rng.uniform(-2, 2, shape))
        layers[name] = torch.from_numpy(values), torch.from_numpy(rng.uniform(size=shape) < share)
    return layers


def single(formula, **numbers):
    """The value of a formula at one cell, None where it is unknown."""
    one = torch.ones(1, 1, 1, dtype=torch.bool)
    layers = {name: (torch.full((1, 1, 1), value, dtype=torch.float64), one) for name, value in numbers.items()}
    value, known = Expression(formula)(layers)
    return float(value) if known else None


@pytest.mark.slow(1)
@pytest.mark.parametrize("formula", FORMULAS)
@settings(max_examples=5)
@given(SEEDS, st.sampled_from([torch.float32, torch.float64]))
def test_formulas_agree_with_numpy(formula, seed, dtype):
    layers = {name: (values.to(dtype), known) for name, (values, known) in random_layers(seed).items()}
    compiled = Expression(formula)
    result, known = compiled({name: layers[name] for name in compiled.names})
    with np.errstate(all="ignore"):
        want = FORMULAS[formula](*(layers[name][0].double().numpy() for name in "abc"))
    exists = np.isfinite(want)
    for name in compiled.names:
        exists &= layers[name][1].numpy()
    np.testing.assert_array_equal(known.numpy(), exists)
    assert result.dtype == dtype and not result[~known].any()
    np.testing.assert_allclose(
        result.numpy()[exists], want[exists], rtol=1e-12 if dtype == torch.float64 else 2e-5, atol=1e-6
    )


def test_spaces_around_a_formula_and_lines_in_parentheses():
    assert single("  x + 1\n", x=1.0) == 2 and single("(x\n + 1)", x=1.0) == 2


def test_names_are_the_layers_in_the_order_of_their_mention():
    assert Expression("slope * elevation - slope / max(variance, 1)").names == ("slope", "elevation", "variance")
    assert Expression("min + abs(max)").names == ("min", "max")  # a function is one only before parentheses


def test_values_that_do_not_exist_are_unknown():
    for formula in (
        "1 / x",
        "x ** -1",
        "log(x)",
        "0 ** (x - 1)",
        "1 / x ** 2",
        "log(x) * 0",
        "min(1, 1 / x)",
        "0 ** x",
    ):
        assert single(formula, x=0.0) is None, formula
    for formula in ("clamp(1 / x, 0, 1)", "clamp(x, 1 / x, 1)", "clamp(x, 0, 1 / x)", "x / 0", "where(1, 1 / x, 0)"):
        assert single(formula, x=0.0) is None, formula
    for formula in ("sqrt(x)", "log(x)", "x ** 0.5", "x ** x", "sqrt(x) > 0"):
        assert single(formula, x=-1.0) is None, formula
    for formula in ("exp(x)", "x ** 20 * x ** 20 * x ** 20", "x * 1e30 * 1e30 * 1e30 * x ** 20 * x ** 20 * x ** 20"):
        assert single(formula, x=1e12) is None, formula
    assert single("x ** 20 * x ** 20 * x ** 20 * 0 + 1", x=1e12) is None  # inf * 0


def test_a_branch_that_is_not_taken_need_not_exist():
    assert single("where(x > 0, 1 / x, 7)", x=0.0) == 7
    assert single("where(x == 0, 7, 1 / x)", x=0.0) == 7
    assert single("where(x == 0, 1 / x, 7)", x=0.0) is None
    assert single("where(1 / x > 0, 1, 2)", x=0.0) is None


def test_known_where_every_layer_is():
    layers = random_layers(0)
    _, known = Expression("where(a > 100, b, c)")(layers)
    assert torch.equal(known, layers["a"][1] & layers["b"][1] & layers["c"][1])


def test_what_unknown_cells_hold_reaches_nothing():
    layers = random_layers(1)
    formula = Expression("a * exp(b) / c + sqrt(abs(a))")
    plain, known = formula(layers)
    for other in (torch.nan, torch.inf, 0.0):
        changed = {n: torch.where(k, v, other).requires_grad_() for n, (v, k) in layers.items()}
        result, still = formula({n: (v, layers[n][1]) for n, v in changed.items()})
        assert torch.equal(result, plain) and torch.equal(still, known)
        for name, gradient in zip(changed, torch.autograd.grad(result.sum(), list(changed.values())), strict=True):
            assert torch.isfinite(gradient).all() and not gradient[~layers[name][1]].any() and gradient.any()


@pytest.mark.slow(1)
@pytest.mark.parametrize("formula", sorted(set(FORMULAS) - {"1 / (a - a)"}))
def test_gradients(formula):
    rng = np.random.default_rng(0)
    values = [torch.from_numpy(rng.uniform(-2, 2, (1, 3, 3))).requires_grad_() for _ in range(3)]
    compiled = Expression(formula)
    known = torch.ones(1, 3, 3, dtype=torch.bool)

    def compute(*values):
        return compiled({name: (v, known) for name, v in zip("abc", values, strict=True) if name in compiled.names})[0]

    assert torch.autograd.gradcheck(compute, values)


SINGULAR = [
    *("1 / x", "x / x", "x ** -3", "x ** 0.5", "x ** x", "x ** 20", "x ** 20 * x ** 20", "sqrt(x)", "log(x)", "exp(x)"),
    *("atan2(x, x)", "exp(exp(x))", "sqrt(x * x)", "where(x > 0, log(x), sqrt(-x))", "abs(x) ** 0.3", "(x / 3) ** x"),
    *("x ** 0", "max(x, 0) ** 0.5", "1 / (1 / x)", "exp(-1 / x ** 2)", "(x * 1e30 + 1e30) * x", "0 ** x"),
    *("clamp(x, 0, 1)", "where(x > 900, (x * 1e29) / (x * 1e-12), x)", "x / 1e-30", "where(x < 1, x / 0, x)"),
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("formula", SINGULAR)
def test_gradients_are_finite_where_functions_have_none(formula, dtype):
    places = [0.0, -0.0, 1e-45, 1e-38, 1e-30, 1e-12, 1e-3, 0.5, 1.0, 3.0, 88.0, 89.0, 1e3, 710.0, 1e9]
    x = torch.tensor([[places, [-v for v in places]]], dtype=dtype).requires_grad_()
    result, known = Expression(formula)({"x": (x, torch.ones_like(x, dtype=torch.bool))})
    (gradient,) = torch.autograd.grad(result.sum(), x)
    assert torch.isfinite(result).all() and torch.isfinite(gradient).all()
    assert not gradient[~known].any() and known.any()


BAD = {
    "": "must be text",
    "  ": "must be text",
    "a +": "column .: cannot be read",
    "a b": "column .: cannot be read",
    "a)": "column .: cannot be read",
    "1 + 2": "must read a layer",
    "9 ** 9 ** 9": "must read a layer",
    "a ** 1000": "column 6: must not hold exponents above 20",
    "a ** -21": "exponents above 20",
    "a + 1e400": "column 5: must not hold numbers above 1e[+]30",
    "a + " + "9" * 600: "must not hold numbers",
    "a + 'b'": "column 5: must not hold 'b'",
    "a + True": "must not hold True",
    "a + 1j": "must not hold 1j",
    "a + None": "must not hold None",
    "a + f(b)": "column 5: there is no function 'f'",
    "a + min(b)": "column 5: min takes 2 or more arguments",
    "a + sqrt(b, c)": "sqrt takes 1 arguments",
    "clamp(a, low=0, high=1)": "clamp takes 3 arguments",
    "min(*a)": "min takes 2",
    "min(a, *b)": "min takes 2",
    "sqrt(a, x=1)": "sqrt takes 1",
    "a // b": "column 1: must not hold 'a // b'",
    "a % b": "must not hold 'a % b'",
    "a @ b": "must not hold",
    "a & b": "must not hold",
    "~a": "must not hold",
    "not a": "must not hold",
    "a and b": "must not hold",
    "a if b else c": "must not hold",
    "a in b": "must not hold",
    "a is b": "must not hold",
    "a[0]": "must not hold",
    "a.real": "must not hold",
    "[a, b]": "must not hold",
    "lambda: a": "must not hold",
    "(a := 1)": "must not hold",
    "[a for a in b]": "must not hold",
    "f'{a}'": "must not hold",
    "a.__class__()": "there is no function",
    "__import__('os').system('true')": "there is no function",
    "(lambda: a)()": "there is no function",
    "sqrt.__call__(a)": "there is no function",
    "import os": "cannot be read",
    "a; b": "cannot be read",
    "a = b": "cannot be read",
    "a\0": "cannot be read",
    "a" * 2000: "must have at most 1000 characters",
    "-" * 900 + "a": "must nest at most 100 operations|cannot be read",
    "not " * 240 + "a": "must not hold|cannot be read",
    "(" * 400 + "a" + ")" * 400: "cannot be read",
    "+".join("a" * 400): "must nest at most 100 operations",
}


@pytest.mark.parametrize("formula", BAD)
def test_refuses_when_it_is_built(formula):
    with pytest.raises(ValueError, match=BAD[formula]):
        Expression(formula)


@pytest.mark.parametrize("formula", [None, 3, ["a"], b"a"])
def test_refuses_what_is_no_text(formula):
    with pytest.raises(ValueError, match="must be text"):
        Expression(formula)


def test_names_the_layers_that_exist():
    assert Expression("slope * 2", available=("elevation", "slope")).names == ("slope",)
    with pytest.raises(ValueError, match="column 5: there is no layer 'slpe'.*there are elevation, slope"):
        Expression("1 - slpe", available=("slope", "elevation"))


@settings(max_examples=300)
@given(st.text(alphabet="ab19. +-*/()<>=,_'\"[]{}:\n\\éminsqrtwhel", max_size=30))
def test_any_text_is_read_or_refused(text):
    try:
        compiled = Expression(text)
    except ValueError:
        return
    ones = torch.ones(1, 2, 2), torch.ones(1, 2, 2, dtype=torch.bool)
    result, known = compiled(dict.fromkeys(compiled.names, ones))
    assert result.shape == known.shape == (1, 2, 2) and torch.isfinite(result).all()


def test_refuses_layers_that_do_not_fit():
    layers = random_layers(0)
    with pytest.raises(ValueError, match="needs d, e, got a, b, c"):
        Expression("a + d + e")(layers)
    layers["b"] = tuple(v[:, 1:] for v in layers["b"])
    with pytest.raises(ValueError, match="one shape"):
        Expression("a + b")(layers)


def test_copies_and_prints():
    layers, formula = random_layers(0), Expression("a + sqrt(b)", available="abc")
    want = formula(layers)
    for twin in (pickle.loads(pickle.dumps(formula)), copy.deepcopy(formula)):
        assert twin.names == formula.names and torch.equal(twin(layers)[0], want[0])
    assert repr(formula) == "Expression('a + sqrt(b)')"


def test_a_batch_equals_single_maps_and_layers_stay_as_they_are():
    layers, formula = random_layers(2, (3, 4, 4)), Expression("a / b + where(c > 0, log(c), a)")
    before = {name: values.clone() for name, (values, _) in layers.items()}
    batch, _ = formula(layers)
    for b in range(3):
        one, _ = formula({name: (values[b : b + 1], known[b : b + 1]) for name, (values, known) in layers.items()})
        assert torch.equal(one[0], batch[b])
    assert all(torch.equal(before[name], layers[name][0]) for name in before)
    same, _ = Expression("a")(layers)
    assert same.data_ptr() != layers["a"][0].data_ptr()


def test_it_is_a_filter_by_name():
    layers = random_layers(3)
    result, known = Filter("expression", formula="b - a")(layers["b"], layers["a"], resolution=0.1)
    assert torch.equal(known, layers["a"][1] & layers["b"][1])
    torch.testing.assert_close(result, (layers["b"][0] - layers["a"][0]) * known)
    assert "expression" in FILTERS
    with pytest.raises(ValueError, match="takes the layers b, a, got 1"):
        expression(layers["b"], formula="b - a")
    Filter("expression", formula="a + 1").try_out(1, 0.04)


def test_runs_without_values():
    """No operation waits for values: "meta" has none."""
    layer = torch.empty(2, 4, 4, device="meta"), torch.empty(2, 4, 4, dtype=torch.bool, device="meta")
    for formula in FORMULAS:
        compiled = Expression(formula)
        assert compiled(dict.fromkeys(compiled.names, layer))[0].shape == (2, 4, 4)


def test_the_three_parts_of_traversability_as_a_formula():
    assert single("where(s > 0.5, 0, 1 - s / 0.5) * 0.5 + 0.5 * max(0, 1 - h / 0.2)", s=0.25, h=0.1) == pytest.approx(
        0.5
    )
    assert math.isclose(single("atan2(y, x)", x=-1.0, y=0.0), math.pi)

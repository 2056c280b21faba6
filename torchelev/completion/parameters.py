"""The weights of the completion network: their shapes, and the features that they multiply."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.completion.context import NUM_CONTEXT, RADII, Context
from torchelev.completion.surroundings import REACHES

if TYPE_CHECKING:
    from jaxtyping import Float

NUM_VIEW = 8 + 2 * len(REACHES)  # features of a direction
NUM_CELL = 8 + NUM_CONTEXT  # of a cell
NUM_CANDIDATES = 2 + len(REACHES)  # heights that each direction proposes
NUM_MEASURED = 7 + NUM_CONTEXT  # of a measured cell
USUAL = 0.04  # [m] resolution that the network's input is relative to
SQUASH = 0.05  # [m] heights count about logarithmically beyond it
SMALL_STEP = 0.01  # [m] steps count about logarithmically beyond it
_SMALL = 1e-6


class Weights(NamedTuple):
    """Parameters of `predict` and `refine`, a matrix and a bias for each layer.

    F features, C channels of a direction, D of a cell, V candidates of a direction, R squares, K of a measured cell.
    """

    view: Float[Tensor, "C F"]  #: the features of a direction
    view_bias: Float[Tensor, "C 1"]  #: first layer of a direction
    view_inner: Float[Tensor, "C C"]  #: second layer
    view_inner_bias: Float[Tensor, "C 1"]  #: second layer of a direction
    cell: Float[Tensor, "D 2C+F"]  #: mean and maximum over the directions, and the features of the cell
    cell_bias: Float[Tensor, "D 1"]  #: first layer of a cell
    cell_inner: Float[Tensor, "D D"]  #: second layer
    cell_inner_bias: Float[Tensor, "D 1"]  #: second layer of a cell
    to_view: Float[Tensor, "C D"]  #: from the cell's features to each direction
    to_view_bias: Float[Tensor, "C 1"]  #: from the cell's features to each direction
    vote: Float[Tensor, "V C"]  #: logits of the candidates, from a direction
    vote_cell: Float[Tensor, "V D"]  #: from the cell
    vote_bias: Float[Tensor, "V 1"]  #: logits of the candidates
    vote_square: Float[Tensor, "R D"]  #: logits of the mean heights of the squares
    vote_square_bias: Float[Tensor, "R 1"]  #: logits of the squares
    answer: Float[Tensor, "2 D"]  #: correction and spread
    answer_bias: Float[Tensor, "2 1"]  #: correction and spread
    measured: Float[Tensor, "K F"]  #: the features of a measured cell
    measured_bias: Float[Tensor, "K 1"]  #: layer of a measured cell
    measured_answer: Float[Tensor, "2 K"]  #: gain and spread
    measured_answer_bias: Float[Tensor, "2 1"]  #: gain and spread
    prior: Float[Tensor, "1"]  #: logarithm of the prior's standard deviation [m]
    calibration: Float[Tensor, "2"]  #: logarithms of the factors on the standard deviations, of unknown and known cells


def weight_shapes(view_channels: int, cell_channels: int, measured_channels: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each weight."""
    C, D, K = view_channels, cell_channels, measured_channels
    matrices = dict(
        view=(C, NUM_VIEW),
        view_inner=(C, C),
        cell=(D, 2 * C + NUM_CELL),
        cell_inner=(D, D),
        to_view=(C, D),
        vote=(NUM_CANDIDATES, C),
        vote_cell=(NUM_CANDIDATES, D),
        vote_square=(len(RADII), D),
        answer=(2, D),
        measured=(K, NUM_MEASURED),
        measured_answer=(2, K),
    )
    biases = {f"{name}_bias": (shape[0], 1) for name, shape in matrices.items() if name not in ("vote", "vote_cell")}
    shapes = matrices | biases | {"vote_bias": (NUM_CANDIDATES, 1), "prior": (1,), "calibration": (2,)}
    return {name: shapes[name] for name in Weights._fields}


def affine(weight: Tensor, columns: Float[Tensor, "F *n"], bias: Tensor) -> Tensor:
    """Return weight @ columns + bias, for any further dimensions of the columns."""
    return torch.addmm(bias, weight, columns.flatten(1)).unflatten(1, columns.shape[1:])


def hidden(weight: Tensor, columns: Float[Tensor, "F *n"], bias: Tensor) -> Tensor:
    """Return relu(weight @ columns + bias)."""
    return torch.relu(affine(weight, columns, bias))


def squash(height: Tensor, scale: float = SQUASH) -> Tensor:
    """Return sign(h) log(1 + |h| / scale): linear below the scale [m], logarithmic above it."""
    ratio = (height.abs() / scale).clamp(min=_SMALL)  # the logarithm has a slope at 0, which a sign does not have
    return height / scale * (torch.log1p(ratio) / ratio)


def describe_context(context: Context, squares: Float[Tensor, "R n"]) -> Float[Tensor, "F n"]:
    """Return the features of squares, whose mean heights `squares` [m] count from the cell's height."""
    known, bounded, steps, _, stds, skewness = (values.to(squares.dtype) for values in context)
    return torch.cat([known, bounded, squash(steps, SMALL_STEP), squash(squares), squash(stds), skewness])

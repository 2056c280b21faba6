"""Holes and how they are filled, cell by cell."""

import numpy as np
import torch

DTYPES = [torch.float64, torch.float32]  # by tensors; by OpenCV


EIGHT = [(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1) if (u, v) != (0, 0)]


FOUR = [(0, 1), (1, 0), (0, -1), (-1, 0)]


def around(shape, cell, steps):
    cells = [(cell[0] + u, cell[1] + v) for u, v in steps]
    return [(u, v) for u, v in cells if 0 <= u < shape[0] and 0 <= v < shape[1]]


def holes(known):
    """The holes of a map (H, W): lists of cells, by a walk from neighbour to neighbour."""
    found, seen = [], known.copy()
    for start in np.ndindex(*known.shape):
        hole, todo = [], [start] if not seen[start] else []
        while todo:
            cell = todo.pop()
            if not seen[cell]:
                seen[cell] = True
                hole.append(cell)
                todo += around(known.shape, cell, EIGHT)
        found += [hole] if hole else []
    return found


def minimum_reference(values, known):
    out = np.where(known, values, np.nan)
    for hole in holes(known):
        border = [values[c] for cell in hole for c in around(known.shape, cell, EIGHT) if known[c]]
        for cell in hole if border else []:
            out[cell] = min(border)
    return out


def nearest_reference(values, known):
    out = np.where(known, values, np.nan)
    cells = np.argwhere(known)  # in the order of i, then j
    for cell in np.argwhere(~known) if len(cells) else []:
        out[tuple(cell)] = values[tuple(cells[((cells - cell) ** 2).sum(1).argmin()])]
    return out


def diffusion_reference(values, known):
    """The linear system, dense."""
    unknown = [tuple(cell) for cell in np.argwhere(~known)]
    if not known.any() or not unknown:
        return np.where(known, values, np.nan)
    number = {cell: k for k, cell in enumerate(unknown)}
    A, right = np.zeros((len(unknown),) * 2), np.zeros(len(unknown))
    for cell, k in number.items():
        for other in around(known.shape, cell, FOUR):
            A[k, k] += 1
            if known[other]:
                right[k] += values[other]
            else:
                A[k, number[other]] -= 1
    out = np.where(known, values, 0.0)
    for cell, height in zip(unknown, np.linalg.solve(A, right), strict=True):
        out[cell] = height
    return out


def assert_filled(got, layer, reference, atol=0.0):
    values, known = (part.numpy() for part in layer)
    expected = np.stack([reference(v, k) for v, k in zip(values, known, strict=True)])
    np.testing.assert_array_equal(got[1].numpy(), ~np.isnan(expected))
    np.testing.assert_allclose(got[0].numpy(), np.nan_to_num(expected), atol=atol, rtol=0)

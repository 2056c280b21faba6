"""A slow copy of the attention encoder, for one environment, from scalars and its weights."""

import math

import numpy as np


def loop_convolution(image, layer, stride):
    """A convolution (C, R, S) with zeros around the image, as many as keep an output centred on its square."""
    weight, bias = (p.detach().double().numpy() for p in (layer.weight, layer.bias))
    size = weight.shape[-1]
    before = (size - stride) // 2
    result = np.zeros((len(weight), image.shape[1] // stride, image.shape[2] // stride))
    for k, i, j in np.ndindex(result.shape):
        total = bias[k]
        for c, a, b in np.ndindex(weight.shape[1:]):
            y, x = i * stride + a - before, j * stride + b - before
            if 0 <= y < image.shape[1] and 0 <= x < image.shape[2]:
                total += weight[k, c, a, b] * image[c, y, x]
        result[k, i, j] = total
    return result


def loop_means(image, patch):
    rows, columns = (size // patch for size in image.shape[1:])
    result = np.zeros((len(image), rows, columns))
    for c, i, j in np.ndindex(result.shape):
        result[c, i, j] = image[c, i * patch : (i + 1) * patch, j * patch : (j + 1) * patch].mean()
    return result


def loop_features(encoder, image, coordinates):
    """What each point knows of itself, [(embed_dim,), ...] row by row."""
    hidden = loop_convolution(image, encoder.features[0], encoder.patch)
    hidden = np.where(hidden > 0, hidden, np.expm1(np.minimum(hidden, 0)))  # ELU
    local = loop_convolution(hidden, encoder.features[2], 1)
    layers = np.concatenate([loop_means(coordinates, encoder.patch), loop_means(image, encoder.patch), local])
    return [layers[:, i, j] for i, j in np.ndindex(layers.shape[1:])]


def loop_attention(encoder, state, image, coordinates):
    """The encoding (embed_dim,) and the weights (heads, P), with a key and a value computed for every point."""
    W = {name: p.detach().double().numpy() for name, p in encoder.named_parameters()}
    points = loop_features(encoder, image, coordinates)
    query = W["query.weight"] @ state + W["query.bias"]
    size = len(query) // encoder.num_heads
    known = loop_means(image, encoder.patch)[encoder.validity].ravel() > 0
    weights, parts = np.zeros((encoder.num_heads, len(points))), []
    for head in range(encoder.num_heads):
        own = slice(head * size, (head + 1) * size)
        keys, values = ([(W[name] @ f)[own] for f in points] for name in ("key.weight", "value.weight"))
        scores = [float(query[own] @ key) / math.sqrt(size) for key in keys]
        if encoder.mask_unknown and known.any():
            scores = [score if seen else -math.inf for score, seen in zip(scores, known, strict=True)]
        elif encoder.mask_unknown:
            scores = [0.0] * len(points)
        powers = [math.exp(score - max(scores)) for score in scores]
        weights[head] = [power / sum(powers) for power in powers]
        parts.append(sum(w * value for w, value in zip(weights[head], values, strict=True)))
    return W["output.weight"] @ np.concatenate(parts) + W["output.bias"], weights

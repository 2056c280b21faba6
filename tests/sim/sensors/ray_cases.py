"""What the tests of ray casting share: difficult terrain, difficult rays, and a fine march to compare with."""

import numpy as np
import torch

from torchelev.sim.sensors.casting import cast
from torchelev.sim.terrains.heightfield import HeightField
from torchelev.sim.terrains.surfaces import Surface

FINE = 5e-4  # [m] step of the march
TERRAINS = ["flat", "slope", "rough", "stairs", "stones", "gaps", "poles"]
RAYS = ["any", "grazing", "horizontal", "down", "up", "along the cells", "outside"]


def one(field, origin, directions, max_range=10.0, boxes=None, tile=0):
    """Cast rays (M, 3), of any length, from one origin."""
    directions = torch.as_tensor(directions, dtype=torch.float64).view(1, -1, 3)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return cast(field, torch.tensor([tile]), torch.tensor([origin]), directions, max_range, boxes)[0]


def flat(height=0.0, size=20, resolution=0.05):
    return HeightField(torch.full((1, size, size), height), resolution)


def unit(rng, *shape):
    d = rng.normal(size=(*shape, 3))
    return torch.from_numpy(d / np.linalg.norm(d, axis=-1, keepdims=True))


def clearance(field, tile, points):
    """Height (N, ...) of points (N, ..., 3) over the surface of tile (N,), NumPy float64."""
    heights = field.heights.double().numpy()
    size = np.array(heights.shape[1:])
    at = np.clip(points[..., :2] / field.resolution + (size - 1) / 2, 0, size - 1)
    cell = np.minimum(at.astype(int), size - 2)
    (u, v), (i, j) = np.moveaxis(at - cell, -1, 0), np.moveaxis(cell, -1, 0)
    k = np.broadcast_to(tile.reshape(-1, *[1] * (points.ndim - 2)), i.shape)
    a, b, c, d = (heights[k, i + m, j + n] for m, n in ((0, 0), (1, 0), (0, 1), (1, 1)))
    return points[..., 2] - BETWEEN[field.surface](a, b, c, d, u, v)


def bilinear(a, b, c, d, u, v):
    return (a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v


def rising(a, b, c, d, u, v):
    """Two triangles, a b d and a d c, by their own corners."""
    return np.where(u > v, a + (b - a) * u + (d - b) * v, a + (d - c) * u + (c - a) * v)


def falling(a, b, c, d, u, v):
    """Two triangles, a b c and d c b."""
    return np.where(u + v < 1, a + (b - a) * u + (c - a) * v, d + (c - d) * (1 - u) + (b - d) * (1 - v))


BETWEEN = dict(zip(Surface, (bilinear, rising, falling), strict=True))  # of corners a (0, 0), b (1, 0), c (0, 1), d
SURFACES = [("bilinear", "rising"), ("triangles", "rising"), ("triangles", "falling")]


def along(origins, directions, t):
    return origins.reshape(-1, *[1] * (t.ndim - 1), 3) + t[..., None] * directions.reshape(-1, *[1] * (t.ndim - 1), 3)


def march(field, tile, origins, directions, max_range, block=200):
    """Distances (N,) to the first sample of a fine march that lies under the ground, bisected; inf where none does."""
    distance = np.full(len(tile), np.inf)
    going = np.arange(len(tile))
    for first in np.arange(0.0, max_range, FINE * block):
        t = np.broadcast_to(first + FINE * np.arange(block + 1), (len(going), block + 1))
        under = clearance(field, tile[going], along(origins[going], directions[going], t)) <= 0
        hit = under.any(1)
        found, step = going[hit], under[hit].argmax(1)
        far = first + FINE * step
        near = np.maximum(far - FINE, 0.0)
        for _ in range(30):
            middle = (near + far) / 2
            above = clearance(field, tile[found], along(origins[found], directions[found], middle)) > 0
            near, far = np.where(above, middle, near), np.where(above, far, middle)
        distance[found] = far
        going = going[~hit]
    return np.where(distance <= max_range, distance, np.inf)


def difficult_terrain(kind, rng, resolution, shape=(44, 40), K=2):
    """Heights (K, H, W) [m]."""
    i, j = np.indices(shape)
    if kind == "flat":
        z = np.zeros((K, *shape))
    elif kind == "slope":
        z = np.stack([(a * i + b * j) * resolution for a, b in rng.uniform(-1, 1, (K, 2))])
    elif kind == "rough":
        z = rng.uniform(-0.05, 0.05, (K, *shape))
    elif kind == "stairs":
        z = np.stack([0.17 * (i // run) - 0.05 * (j // 9) for run in rng.integers(3, 9, K)])
    elif kind == "stones":
        z = np.stack([np.where((i % p < 0.6 * p) & (j % p < 0.6 * p), 0.05, -0.8) for p in rng.integers(4, 12, K)])
    elif kind == "gaps":
        z = np.stack([np.where((i + j) % p < 3, -1.0, 0.0) for p in rng.integers(7, 14, K)])
    elif kind == "poles":
        z = np.where(rng.uniform(size=(K, *shape)) < 0.02, rng.uniform(0.1, 0.8, (K, *shape)), 0.0)
    return HeightField(torch.from_numpy(z), resolution)


def difficult_rays(kind, rng, field, N):
    """Tiles (N,), origins (N, 3) and directions (N, 3), NumPy."""
    tile = rng.integers(field.num_tiles, size=N)
    half = np.array(field.heights.shape[1:]) * field.resolution / 2
    xy = rng.uniform(-1, 1, (N, 2)) * half * (1.8 if kind == "outside" else 0.95)
    ground = -clearance(field, tile, np.column_stack([xy, np.zeros(N)]))
    low = kind in ("grazing", "horizontal")
    origins = np.column_stack([xy, ground + rng.uniform(0.001, 0.05 if low else 0.8, N)]).astype(np.float32)
    d = rng.normal(size=(N, 3))
    if kind == "grazing":
        d[:, 2] *= 0.05
    elif kind == "horizontal":
        d[:, 2] = 0.0
    elif kind == "down":
        d[:, :2] *= rng.uniform(0, 0.3, (N, 1)) ** 3
        d[:, 2] = -1.0
    elif kind == "up":
        d[:, 2] = 0.3 * abs(d[:, 2])
    elif kind == "along the cells":
        d[np.arange(N), rng.integers(2, size=N)] = 0.0
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return tile, origins, d


def scene(seed, B=3, M=40, kind="any", resolution=0.04):
    """A field of mixed terrain and surface, and rays from one origin per environment."""
    rng = np.random.default_rng(seed)
    field = difficult_terrain(TERRAINS[seed % len(TERRAINS)], rng, resolution, K=B)
    field = field.with_surface(*SURFACES[seed // len(TERRAINS) % len(SURFACES)])
    tile, origins, _ = difficult_rays(kind, rng, field, B)
    return field, torch.from_numpy(tile), torch.from_numpy(origins), unit(rng, B, M).float()


def same(one, other, atol=5e-5):
    torch.testing.assert_close(one, other, atol=atol, rtol=0)

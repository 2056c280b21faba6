"""Robots that walk and map, a network that loses, repeats and reorders, and sites to compare."""

import random

import pytest
import torch

from tests.helpers import pose, seen_from, small_map
from tests.site.helpers import ground, known_cells
from torchelev import AgingConfig
from torchelev.site import SiteMap
from torchelev.site.service.outbox import Outbox
from torchelev.site.service.server.merger import SiteServer
from torchelev.site.service.snapshots import read_snapshot

START = 1.7e9  # [s] on the clock that all share
CELLS = 40, 36
#: Drift compensation moves heights that nobody measured again, and ageing weighs heights by when they were merged:
#: without them, the site is a sum of what the robots measured, in whatever steps it was merged.
EXACT = {"drift": None, "aging": AgingConfig(variance_rate=0.0)}


class Walker:
    """A robot that walks along x and maps the ground around it."""

    def __init__(self, name="a", y=0.0, seed=0, cells=CELLS):
        self.name, self.y, self.x, self.time = name, y, 0.0, START
        self.emap = small_map(1, cells, **EXACT)
        self._generator = torch.Generator().manual_seed(seed)

    def step(self, dx=0.3, dt=1.0, num_points=4000):
        self.x, self.time = self.x + dx, self.time + dt
        T = pose((self.x, self.y, 1.0))
        xy = 4.4 * torch.rand(1, num_points, 2, generator=self._generator).double() - 2.2
        xy = xy + torch.tensor([self.x, self.y])
        noise = 0.005 * torch.randn(1, num_points, generator=self._generator)
        points = torch.cat([xy, (ground(xy[..., 0], xy[..., 1]) + noise)[..., None]], -1)
        self.emap.update(seen_from(T, points).float(), T, T, dt)

    def snapshot(self):
        return read_snapshot(self.emap, torch.arange(1), self.time)


class Network:
    """A server and the outboxes of robots, on a clock of their own [s]."""

    def __init__(self, walkers, path=None, loss=0.0, repeats=0.0, disorder=0.0, seed=0, **server):
        self.time, self.is_down, self.random = 0.0, False, random.Random(seed)
        self.loss, self.repeats, self.disorder = loss, repeats, disorder
        self.path, self.options, self.in_transit, self.num_bytes = path, server, [], 0
        self.walkers, self.outboxes = walkers, {walker.name: Outbox(walker.name, 0.1) for walker in walkers}
        self.direct = SiteMap(0.1)
        self.start()

    def start(self):
        self.server = SiteServer(self.path, clock=lambda: START + 1e6, align=False, **self.options)

    def walk(self, **step):
        """Let all walk, publish, and merge directly, too."""
        for walker in self.walkers:
            walker.step(**step)
            self.direct.merge(walker.emap, time=walker.time, align=False)
            self.outboxes[walker.name].add(walker.snapshot())

    def exchange(self, seconds=1.0, step=0.1):
        """Let the network carry what is due."""
        for _ in range(round(seconds / step)):
            self.time += step
            for name, outbox in self.outboxes.items():
                payload = outbox.next_message(self.time)
                if payload is not None:
                    self.num_bytes += len(payload)
                    self._carry(lambda p=payload, n=name: self.server.handle(p, n))
            self._deliver()
            for answer in self.server.step():
                for name in [answer.robot] if answer.robot else self.outboxes:
                    self._carry(lambda p=answer.payload, n=name: self.outboxes[n].receive(p, self.time))
            self._deliver()

    def _carry(self, deliver):
        copies = 1 + (self.random.random() < self.repeats)
        for _ in range(copies if not self.is_down and self.random.random() >= self.loss else 0):
            self.in_transit.append((self.time + self.disorder * self.random.random(), deliver))

    def _deliver(self):
        due = sorted((each for each in self.in_transit if each[0] <= self.time), key=lambda each: each[0])
        self.in_transit = [each for each in self.in_transit if each[0] > self.time]
        for _, deliver in due:
            deliver()

    def drain(self, seconds=300.0):
        """Let the network carry all that waits, and what is still on its way."""
        end = self.time + seconds
        while not all(outbox.is_empty for outbox in self.outboxes.values()) and self.time < end:
            self.exchange()
        self.exchange(self.disorder + 1.0)
        assert all(outbox.is_empty for outbox in self.outboxes.values())


def assert_same(site, other, layers=("elevation", "variance", "upper_bound", "other_elevation")):
    """Two sites know the same cells, to 1e-6."""
    for layer in layers:
        a, b = known_cells(site, layer), known_cells(other, layer)
        assert a.keys() == b.keys(), (layer, len(a), len(b), len(a.keys() ^ b.keys()))
        for cell, value in a.items():
            assert value == pytest.approx(b[cell], abs=1e-6), (layer, cell)

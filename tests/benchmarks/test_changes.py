"""The benchmark of obstacles that come and people who go: what it counts, and what it writes."""

import json

import pytest
import torch
from click.testing import CliRunner

from benchmarks.quality import changes


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(changes, "WATCHED", 3)
    monkeypatch.setattr(changes, "SECONDS", 0.4)
    monkeypatch.setattr(changes, "CROSSINGS", 1)
    monkeypatch.setattr(changes, "AFTER", 0.4)


GONE = {"cells": 3, "environments": 2, "seen_through": 0, "environments_seen_through": 0, "of": 50}


def world(seeds=2):
    return changes.World(changes.SENSORS["camera 64 x 48"], seeds, compiled=False)


def test_hits_are_counted_in_the_cells_in_which_the_obstacle_stands():
    here = world(1)
    boxes = here.box(torch.tensor([2.65]), torch.zeros(1), changes.OBSTACLES["box"])
    at = torch.tensor([2.55, 0.02, 0.0])
    ground = float(here.field.height(here.tiles, at[None, None, :2]))
    # The box begins at x = 2.5, the centre of the cell of x = 2.51.
    places = [(2.55, 0.02, 0.2), (2.55, 0.02, 0.02), (2.55, 1.0, 0.2), (2.51, 0.02, 0.2), (2.47, 0.02, 0.2)]
    on, below, beside, rim, before = ([x, y, ground + z] for x, y, z in places)
    points = torch.tensor([[on, on, below, beside, rim, before, [torch.nan] * 3]])
    number = changes.hits(here, points, boxes)
    assert number.sum() == 3 and number.max() == 2
    center = here.emap.cell_centers()[number == 2][0]
    assert (center - at[:2]).abs().max() <= changes.HALF_CELL
    assert changes.hits(here, points, boxes, beside=-0.001).sum() == 2, "the box covers this cell's centre"


def test_an_obstacle_shows_and_settled_ground_delays_it(small):
    row = changes.obstacle_scans(changes.SENSORS["camera 64 x 48"], "wall", 1.0, seeds=2, settled=1, compiled=False)
    assert row["median"] <= 3 and row["points"] > 0.5
    assert world().above_ground().isnan().all()


def test_scans_are_counted_until_something_first_shows():
    yes, no = torch.tensor([True, False, False]), torch.tensor([False, True, False])
    assert changes.scans_until([yes, no, no]) == {"median": 2, "most": 4}


@pytest.mark.slow(5)
def test_a_plate_shows_sooner_where_ground_ages_faster(monkeypatch):
    monkeypatch.setattr(changes, "WATCHED", 12)
    slow, fast = (
        changes.plate_scans(changes.SENSORS["camera 120 x 90"], rate, seeds=2, settled=25, compiled=False)
        for rate in (0.0, 1e-2)
    )
    assert fast["median"] < slow["median"] and fast["rmse_mm"] > slow["rmse_mm"] > 0


def test_ghosts_are_what_stays_above_the_ground(small, monkeypatch):
    row = changes.ghosts(changes.SENSORS["camera 64 x 48"], 10, seeds=2, compiled=False)
    assert row["of"] == 2 and row["environments"] <= 2
    monkeypatch.setattr(changes, "AFTER", 0.0)  # while the person still stands there
    monkeypatch.setattr(changes, "SECONDS", 2.0)
    monkeypatch.setattr(
        changes,
        "crossing",
        lambda w, dt: (w.box(torch.full((2,), 2.5), torch.zeros(2), changes.PERSON) for _ in range(5)),
    )
    assert changes.ghosts(changes.SENSORS["camera 64 x 48"], 10, seeds=2, compiled=False)["environments"] == 2


def test_cells_are_seen_through_where_a_ray_passes_below_and_beyond():
    here = world(1)
    T = here.T_map_sensor[0, :3, 3].float()
    here.emap.elevation.fill_(float(T[2]) - 0.45)
    centers = here.emap.cell_centers()[0]
    cells = (centers - torch.tensor([1.02, 0.02])).norm(dim=-1)[None] < 0.01
    assert cells.sum() == 1
    for end, number in (
        ((2.0, 0.04), 1),
        ((2.0, 0.1), 0),
        ((1.05, 0.02), 0),
        ((-2.0, 0.0), 0),
        ((3.0, 0.06), 0),
        ((2.15, 0.04), 0),
    ):
        point = torch.tensor([[[*end, float(T[2]) - 1.0]]])  # a ray falls 0.51 m on 1.02 m of 2 m, 0.47 m of 2.15 m
        assert changes.seen_through(here, cells, point).tolist() == [number], end


def test_the_command_writes_and_tabulates(small, monkeypatch, tmp_path):
    monkeypatch.setattr(changes, "obstacle_scans", lambda *given: {"median": 3, "most": 4, "points": 0.5})
    monkeypatch.setattr(changes, "plate_scans", lambda *given: {"rmse_mm": 0.2, "median": 3, "most": 61})
    monkeypatch.setattr(changes, "ghosts", lambda *given: GONE)
    result = CliRunner().invoke(changes.main, ["--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "| box, 100.0% of the points | 0.5 | 3 | > 3 |" in result.output
    assert len(json.loads((tmp_path / "changes.json").read_text())["ghosts"]) == len(changes.SENSORS) * len(
        changes.HERTZ
    )

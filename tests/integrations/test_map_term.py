"""What all terms do: read as an observation, keep no view of the map, and refuse settings that do not fit."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from tests.integrations.simulators import CFG, Env, GroundSource, term_cfg
from torchelev import ElevationMapConfig, GridConfig, HeightScan, MapImage
from torchelev.integrations.map_term import MapTerm


def term_class(read, **settings):
    """A term over flat ground 0.4 m below its robots, as a user would derive it."""

    class Term(MapTerm):
        map_cfg = CFG

        def __init__(self, cfg, env):
            source = GroundSource(torch.tensor([[0.0, 0.0, 0.4], [5.0, 0.0, 1.4]]), torch.tensor([0.0, 1.0]))
            self._set_up(cfg, env, source)

        def __call__(self, env):
            return self._observe(env)

    Term.read = read
    for name, value in settings.items():
        setattr(Term, name, value)
    return Term


def observe(read, params=None, steps=1, **settings):
    env = Env(num_envs=2)
    term = term_class(read, **settings)(term_cfg(None, **(params or {})), env)
    values = term(env)
    for step in range(steps):
        env.common_step_counter = step + 1
        values = term(env)
    return values, term, env


def test_reads_a_height_scan():
    values, _, _ = observe(HeightScan.mjlab())
    torch.testing.assert_close(values, torch.full((2, 187), 0.4 / 5), atol=1e-4, rtol=0)


def test_an_empty_map_reads_the_standing_height():
    values, _, _ = observe(HeightScan.mjlab(), {"standing_height": 0.3}, steps=0)
    torch.testing.assert_close(values, torch.full((2, 187), 0.3 / 5))


def test_appends_the_validity():
    _, term, env = observe(HeightScan.mjlab(), with_validity=True)
    term.emap.reset(torch.tensor([0]))
    values = term(env)
    expected, valid = HeightScan.mjlab()(term.emap, term.maps.source.read_base(None))
    assert values.shape == (2, 374)
    assert valid.any(-1).tolist() == [False, True]
    torch.testing.assert_close(values, torch.cat([expected, valid.float()], -1))


def test_appends_the_validity_to_each_row_of_a_scan_with_channels():
    cfg = dataclasses.replace(CFG, channels={"rgb": "color"})
    values, term, _ = observe(HeightScan.mjlab(channels=("rgb",), channel_fill=0.5), with_validity=True, map_cfg=cfg)
    assert values.shape == (2, 8, 187)
    expected, valid = HeightScan.mjlab()(term.emap, term.maps.source.read_base(None))
    torch.testing.assert_close(values[:, 0], expected)
    assert torch.equal(values[:, 4], valid.float()) and valid.any()
    assert (values[:, 1:4] == 0.5).all() and not values[:, 5:].any()


def test_reads_an_image():
    image = MapImage(length_x=1.0, length_y=0.6, resolution=0.1, layers=("elevation", "validity"))
    values, _, _ = observe(image)
    assert values.shape == (2, 2, 10, 6)
    torch.testing.assert_close(values[:, 0], torch.full((2, 10, 6), -0.4), atol=1e-4, rtol=0)
    assert (values[:, 1] == 1).all()


def test_a_function_may_return_a_view_or_nan():
    values, term, _ = observe(lambda emap, T_map_base: emap.elevation)
    assert values.data_ptr() != term.emap.elevation.data_ptr()
    values, _, _ = observe(lambda emap, T_map_base: emap.layer("elevation"))
    assert values.isfinite().all()


@pytest.mark.parametrize("read", [HeightScan.mjlab(), lambda emap, T_map_base: emap.elevation])
def test_a_stored_observation_stays_as_it_was(read):
    """PPO keeps the observation while the environment steps."""
    stored, term, env = observe(read)
    copy = stored.clone()
    term.maps.source.height += 0.05
    env.common_step_counter += 1
    later = term(env)
    assert (later != copy).any()
    torch.testing.assert_close(stored, copy, rtol=0, atol=0)


def test_observes_in_inference_mode():
    with torch.inference_mode():
        values, term, env = observe(HeightScan.mjlab())
    term.reset(torch.tensor([0]))
    env.common_step_counter += 1
    torch.testing.assert_close(term(env), values)


@pytest.mark.parametrize(
    "read, params, settings, error, words",
    [
        (HeightScan.mjlab(), {}, {"map_cfg": ElevationMapConfig(grid=GridConfig(length_x=1.0, length_y=1.0))},
         ValueError, "pattern: must lie in the map at any heading"),
        ("height_scan", {}, {}, ValueError, "read: must be callable, got str; set it to a HeightScan"),
        (MapImage(), {"standing_height": 0.3}, {}, ValueError, "standing_height: needs a HeightScan, got MapImage"),
        (HeightScan.mjlab(), {"standing_height": "tall"}, {}, ValueError, "standing_height: must be a finite number"),
        (lambda emap, T: None, {}, {}, ValueError, r"read: must return a tensor \(2, ...\), got NoneType"),
        (lambda emap, T: torch.zeros(3, 4), {}, {}, ValueError, r"read: must return a tensor \(2, ...\), got \(3, 4\)"),
        (HeightScan.mjlab(), {"update_every": 0}, {}, ValueError, "update_every: must be a positive int"),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(read, params, settings, error, words):
    with pytest.raises(error, match=words):
        observe(read, params, **settings)


@pytest.mark.parametrize("name, value", [("scale", 0.2), ("noise", SimpleNamespace(n_min=-0.1, n_max=0.1))])
def test_refuses_a_second_scale(name, value):
    cfg = term_cfg(None)
    setattr(cfg, name, value)
    with pytest.raises(ValueError, match=f"{name}: must be left out, as the height scan multiplies by 0.2 itself"):
        term_class(HeightScan.mjlab())(cfg, Env(num_envs=2))
    term_class(HeightScan.mjlab(scale=1.0))(cfg, Env(num_envs=2))  # the manager scales, as for mjlab's own scan

"""Images of the map: by hand, and against scans of a grid."""

import dataclasses
import math

import pytest
import torch

from tests.helpers import pose
from tests.observations.maps import BASE, ground_map, plane, random_base, random_map
from torchelev.kernels.cpu_build import find_compiler
from torchelev.observations import image_kernel
from torchelev.observations.fill import MODES
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import CHANNELS as ALL
from torchelev.observations.map_image import MapImage
from torchelev.observations.patterns import ALIGNMENTS

CHANNELS = tuple(name for name in ALL if name != "clearance")  # of maps without levels


def test_an_image_by_hand():
    """Base at (0.3, -0.2, 0.7), looking along +y: pixel [0, 0] of 4 x 2 of 0.1 m lies at (-0.15, -0.05) from it."""
    emap = ground_map(plane, variance=0.04, traversability=0.6, upper_bound=0.3)
    image = MapImage(length_x=0.4, length_y=0.2, resolution=0.1, layers=CHANNELS)
    assert image.shape == (5, 4, 2)
    T = pose(BASE, yaw=math.pi / 2)
    elevation, validity, variance, bound, traversability = image(emap, T)[0]
    # (-0.15, -0.05) -> (0.35, -0.35): -0.035; one more i: y + 0.1; one more j: x - 0.1.
    assert elevation[0, 0] == pytest.approx(-0.035 - 0.7) and elevation[1, 0] == pytest.approx(-0.015 - 0.7)
    assert elevation[0, 1] == pytest.approx(-0.045 - 0.7) and torch.equal(bound, elevation)
    assert (validity == 1).all()
    assert variance.numpy() == pytest.approx(0.04) and traversability.numpy() == pytest.approx(0.6)
    offset = dataclasses.replace(image, offset=(0.1, 0.1), nominal_height=0.5)(emap, T)[0, 0]
    assert offset[0, 0] == pytest.approx(-0.035 + 0.02 - 0.01 - 0.7 + 0.5)


def test_what_an_image_does_not_know_is_0():
    emap = ground_map(plane, variance=0.04, traversability=0.6, upper_bound=0.3)
    emap.validity[:, :15] = False
    emap.bounded[:, 13] = True
    image = MapImage(length_x=0.6, length_y=0.2, resolution=0.1, layers=CHANNELS, mode="nearest")
    channels = image(emap, pose(BASE))[0]
    assert not channels[:5, :1].any() and not channels[[0, 1, 2, 4], :3].any()
    assert channels[3, 1].numpy() == pytest.approx(0.3 - 0.7) and not channels[3, 2].any()
    assert (channels[:, 3:] != 0).all() and (channels[5:] != 0).all()
    emap.reset()
    assert not image(emap, pose(BASE)).any()


def test_an_image_shows_ratings_where_they_are_known():
    """Elevations may be known where ratings are not."""
    emap = ground_map(plane, traversability=0.6)
    emap.rated.copy_(emap.cell_centers()[..., 0] > 0.3)
    image = MapImage(length_x=0.4, length_y=0.2, resolution=0.1, alignment="world", mode="nearest")(emap, pose(BASE))
    assert image.shape == (1, 4, 4, 2) and (image[0, 1] == 1).all()
    expected = torch.tensor([0.0, 0.0, 0.6, 0.6], dtype=torch.float64)[:, None].expand(4, 2)
    torch.testing.assert_close(image[0, 3], expected)


@pytest.mark.parametrize("mode", MODES)
def test_images_are_scans_of_a_grid(mode):
    emap, rng = random_map(7)
    T = random_base(emap, rng)
    pixels = HeightScan.grid(length_x=0.5, length_y=0.3, resolution=0.1, mode=mode, fill="base")
    image = MapImage(length_x=0.6, length_y=0.4, resolution=0.1, layers=("validity", "elevation"), mode=mode)
    channels = image(emap, T)
    values, valid = pixels(emap, T)
    torch.testing.assert_close(channels[:, 1].flatten(1), -values)
    assert torch.equal(channels[:, 0].flatten(1), valid.double())


@pytest.mark.slow(1)
@pytest.mark.parametrize("layers", [CHANNELS, CHANNELS[::-1], ("validity",), ("upper_bound", "variance")], ids=str)
@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("mode", MODES)
def test_images_are_the_same_in_cpp(mode, alignment, layers, monkeypatch):
    emap, rng = random_map(11, dtype=torch.float32)
    T = random_base(emap, rng)
    image = MapImage(length_x=0.7, length_y=0.5, resolution=0.1, layers=layers, alignment=alignment, mode=mode)
    poses = (
        T,
        T.float(),
        T.clone().index_put_((torch.tensor([1]), *torch.tensor([[2], [3]])), torch.tensor(2.5).double()),
    )
    for base in poses:
        got = image(emap, base)
        assert got.dtype == torch.float32 and got.any()
        with monkeypatch.context() as patch:
            patch.setenv("TORCHELEV_NATIVE", "0")
            torch.testing.assert_close(got, image(emap, base), rtol=0, atol=2e-6)


@pytest.mark.skipif(find_compiler() is None, reason="no compiler")
def test_images_are_read_in_cpp(monkeypatch):
    """Not where there is something to differentiate, nor where a channel is there twice."""
    emap, rng = random_map(11, dtype=torch.float32)
    T, image = random_base(emap, rng), MapImage(length_x=0.7, length_y=0.5, resolution=0.1)
    twice = dataclasses.replace(image, layers=("elevation", "elevation"))(emap, T)
    assert torch.equal(twice[:, 0], image(emap, T)[:, 0]) and torch.equal(twice[:, 1], twice[:, 0])
    (gradient,) = torch.autograd.grad(image(emap, T.requires_grad_()).sum(), T)
    assert gradient.any()
    monkeypatch.setattr(image_kernel, "read_images", lambda *arguments: torch.full((2, 4, 35), 3.0))
    assert (image(emap, T.detach()) == 3).all() and not (image(emap, T) == 3).all()


def test_where_an_images_pixels_lie():
    image = MapImage(length_x=0.4, length_y=0.2, resolution=0.1, offset=(1.0, 0.0))
    left = torch.tensor([[[0.0, -1, 0, 3], [1, 0, 0, 5], [0, 0, 1, 7], [0, 0, 0, 1]]], dtype=torch.float64)
    xy = image.xy(left)[0]  # the base at (3, 5) looks along +y: ahead is +y, left is -x
    assert xy.shape == (8, 2)
    torch.testing.assert_close(xy[0], torch.tensor([3.05, 5.85], dtype=torch.float64))
    torch.testing.assert_close(xy[1], torch.tensor([2.95, 5.85], dtype=torch.float64))
    torch.testing.assert_close(xy[7], torch.tensor([2.95, 6.15], dtype=torch.float64))

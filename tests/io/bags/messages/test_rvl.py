"""Depth compressed by RVL comes out as it went in; what is cut or damaged is refused."""

import random
import struct

import numpy as np
import pytest

from torchelev.io.bags.messages.cloud import CloudError
from torchelev.io.bags.messages.depth_png import decode_depth
from torchelev.io.bags.messages.rvl import decode_rvl

FORMAT = "16UC1; compressedDepth rvl"


def encode(image):
    """The paper's listing, number by number."""
    nibbles = []

    def put(number):
        while number > 7:
            nibbles.append(number & 7 | 8)
            number >>= 3
        nibbles.append(number)

    pixels, k, last = image.ravel().tolist(), 0, 0
    while k < len(pixels):
        for is_run in (lambda pixel: pixel == 0, lambda pixel: pixel != 0):
            start = k
            while k < len(pixels) and is_run(pixels[k]):
                k += 1
            put(k - start)
        for pixel in pixels[start:k]:
            put((pixel - last) * 2 if pixel >= last else (last - pixel) * 2 - 1)
            last = pixel
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack(f"<II{len(words)}I", image.shape[1], image.shape[0], *words)


def example(seed, share=0.3):
    rng = np.random.default_rng(seed)
    image = rng.integers(1, 65536, (13, 17)).astype(np.uint16)
    return np.where(rng.random(image.shape) < share, 0, image).astype(np.uint16)


@pytest.mark.parametrize("image", [example(0), example(1, 0.0), example(2, 1.0), np.full((1, 1), 7, np.uint16)])
def test_an_image_comes_out_as_it_went_in(image):
    np.testing.assert_array_equal(decode_rvl(encode(image)), image)
    depth = decode_depth(bytes(12) + encode(image), FORMAT)
    np.testing.assert_allclose(depth, image * 1e-3, atol=1e-6)


def test_quantised_depth_is_that_of_the_header():
    image, a, b = example(3), 10100.0, -1009.0
    depth = decode_depth(struct.pack("<iff", 0, a, b) + encode(image), "32FC1; compressedDepth rvl")
    np.testing.assert_allclose(depth[image > 0], a / (image[image > 0] - b), rtol=1e-6)
    assert (depth[image == 0] == 0).all()


def test_what_is_cut_or_damaged_is_refused_or_read():
    whole, generator = encode(example(4)), random.Random(0)
    for size in range(0, len(whole) - 4, 7):
        with pytest.raises(CloudError, match="RVL of a depth image is cut short or damaged"):
            decode_rvl(whole[:size])
    for _ in range(50):
        damaged = bytearray(whole)
        damaged[generator.randrange(8, len(whole))] ^= generator.randrange(1, 256)
        try:
            decode_rvl(bytes(damaged))
        except CloudError as error:
            assert "damaged" in str(error)

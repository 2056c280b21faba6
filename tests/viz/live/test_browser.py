"""The page in a real browser: it opens, draws the surface, switches the layer, and says what a cell holds."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from docs.browser import Browser, find_browser
from tests.helpers import pose, wait_for
from tests.viz.live.test_page import mapped_step
from torchelev.viz.live import LiveView

pytestmark = [
    pytest.mark.slow(15),
    pytest.mark.skipif(find_browser() is None, reason="no chromium or chrome on the PATH"),
]
SIZE = (900, 600)
_CENTER_OF = """(() => {
    const found = [...document.querySelectorAll(%r)].filter(e => (e.value ?? e.textContent) === %r);
    if (!found.length) return null;
    const box = found[0].getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
})()"""


def pixels(browser):
    """The scene (H, W, 3), without the panel at its right."""
    picture = np.asarray(Image.open(io.BytesIO(browser.picture())).convert("RGB")).astype(int)
    return picture[:, : SIZE[0] // 2]


def num_colored(picture):
    return int((picture.max(-1) - picture.min(-1) > 40).sum())


def click_on(browser, kind, text):
    """Click on an element once it stands still."""
    place, before = browser.wait_for(_CENTER_OF % (kind, text)), None
    while place != before:
        time.sleep(0.5)
        place, before = browser.wait_for(_CENTER_OF % (kind, text)), place
    browser.click(*place)


def test_the_page_in_a_browser(port):
    emap, T, _ = mapped_step()
    with LiveView(emap, port=port) as view:
        assert view.show(pose((0, 0, 0.5)), T)
        with Browser(view.page.url, SIZE) as browser:
            browser.wait_for("document.querySelector('canvas') !== null")
            wait_for(lambda: num_colored(pixels(browser)) > 1000, seconds=120)
            browser.wait_for("document.body.innerText.includes('elevation [m]')")

            click_on(browser, "input", "elevation")
            click_on(browser, "[role=option]", "traversability")
            browser.wait_for("!document.body.innerText.includes('elevation [m]')")
            assert view.page.layer == "traversability"

            colored = pixels(browser).max(-1) - pixels(browser).min(-1) > 40
            row, column = (int(np.median(index)) for index in np.nonzero(colored))
            browser.click(column, row)
            browser.wait_for("document.body.innerText.includes('Cell at (')")

            first = pixels(browser)
            emap.reset()
            wait_for(lambda: view.show(pose((0, 0, 0.5)), T), seconds=120)
            wait_for(
                lambda: num_colored(pixels(browser)) < num_colored(first) / 3, seconds=120
            )  # the map is gone from the page

"""Take the picture of the live view: the demo's walk in a browser without a screen.

    python -m docs.figures.live_view

Needs chromium and `pip install 'torchelev[view]'`. Writes docs/pictures/live_view.png.
"""

from __future__ import annotations

import io
import time
from pathlib import Path

import click
from PIL import Image

from docs.browser import Browser
from torchelev.app.demo import DT, DemoWalk
from torchelev.files.output_files import atomic_file
from torchelev.viz.live import Page, Player, take_snapshot

PICTURE = Path(__file__).parents[1] / "pictures" / "live_view.png"
_SIZE, _SHOWN, _COLORS = (1200, 860), (1200, 700), 128
# Says that there is no GPU, which a reader of the page need not know.
_CLOSE_NOTES = "document.querySelectorAll('.mantine-Notification-root').forEach(note => note.remove())"


@click.command(help=__doc__)
@click.option("--scans", default=60, show_default=True, help="Scans of the walk before the picture is taken.")
def main(scans: int) -> None:
    """Walk, open the page, take the picture."""
    demo = DemoWalk(scans * DT)
    page = Page("demo", demo.emap.layers)
    Player(page, len(demo.path.times))  # for its controls
    for scan in demo:
        scene = scan.T_map_base, scan.T_map_sensor, scan.points
        page.draw(take_snapshot(demo.emap, *scene), f"Scan {scans}, {scan.time:.1f} s")
    with Browser(page.url, _SIZE) as browser:
        browser.wait_for("document.querySelector('canvas') !== null")
        time.sleep(5)
        browser.evaluate(_CLOSE_NOTES)
        browser.picture()  # the page fades in
        picture = Image.open(io.BytesIO(browser.picture())).convert("RGB")
    page.stop()
    with atomic_file(PICTURE) as file:
        small = picture.crop((0, 0, *_SHOWN)).quantize(_COLORS, dither=Image.Dither.NONE)
        small.save(file, format="png", optimize=True)


if __name__ == "__main__":
    main()

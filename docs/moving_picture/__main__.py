"""Draw docs/pictures/walk.webp, the moving picture.

    python -m docs.moving_picture          # about five minutes on two cores

Needs pyvista beside torchelev[io,dev]: ``pip install pyvista``. Renders without a screen, on a GPU or a CPU (EGL).
"""

from __future__ import annotations

from pathlib import Path

import click
from tqdm import tqdm

from docs.moving_picture.film import frames, save_film

PICTURES = Path(__file__).parents[1] / "pictures"
_FIRST = 0.72  # of the film: the frame that it begins with


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES, help="Output folder.")
@click.option("--seconds", type=float, default=None, help="Only the beginning, for a try.")
def main(out: Path, seconds: float | None) -> None:
    """Render the film."""
    out.mkdir(parents=True, exist_ok=True)
    images = list(tqdm(frames(seconds), unit="frame", disable=None))
    save_film(images, out / "walk.webp", round(_FIRST * (len(images) - 1)))


if __name__ == "__main__":
    main()

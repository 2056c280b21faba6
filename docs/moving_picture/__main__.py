"""Draw docs/pictures/walk.webp, the moving picture, and walk.png, its still.

    python -m docs.moving_picture          # about five minutes on two cores

Needs pyvista beside torchelev[io,dev]: ``pip install pyvista``. Renders without a screen, on a GPU or a CPU (EGL).
"""

from __future__ import annotations

from pathlib import Path

import click
from PIL import Image
from tqdm import tqdm

from docs.moving_picture.film import frames, save_film
from torchelev.files.output_files import atomic_file

PICTURES = Path(__file__).parents[1] / "pictures"
_STILL = 0.72  # of the film


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES, help="Output folder.")
@click.option("--seconds", type=float, default=None, help="Only the beginning, for a try.")
def main(out: Path, seconds: float | None) -> None:
    """Render the film and its still."""
    out.mkdir(parents=True, exist_ok=True)
    images = list(tqdm(frames(seconds), unit="frame", disable=None))
    save_film(images, out / "walk.webp")
    with atomic_file(out / "walk.png") as file:
        still = images[round(_STILL * (len(images) - 1))]
        still.quantize(256, dither=Image.Dither.NONE).save(file, format="png", optimize=True)


if __name__ == "__main__":
    main()

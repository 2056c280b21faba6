"""Draw what usual mistakes do to a map: the right map beside the wrong one.

    python -m docs.mistakes              # all of them, half a minute
    python -m docs.mistakes optical legs

Writes docs/pictures/mistake-NAME.png and prints what `diagnose` says of each.
"""

from __future__ import annotations

from pathlib import Path

import click
import torch

from docs.mistakes.cases import CASES, right_map, wrong_map
from docs.mistakes.pictures import draw

PICTURES = Path(__file__).parents[1] / "pictures"


@click.command(help=__doc__)
@click.argument("names", nargs=-1, type=click.Choice(list(CASES)))
def main(names: tuple[str, ...]) -> None:
    """Write the pictures."""
    torch.set_num_threads(1)
    PICTURES.mkdir(exist_ok=True)
    for name in names or CASES:
        case = CASES[name]
        wrong = wrong_map(case)
        draw(case, right_map(case), wrong).savefig(PICTURES / f"mistake-{name}.png", dpi=90)
        click.echo(f"{name}: {' | '.join(wrong.diagnose()) or 'nothing'}")


if __name__ == "__main__":
    main()

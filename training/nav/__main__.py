"""Train a policy: `python -m training.nav`."""

from training.nav.train import main

main(prog_name="python -m training.nav")

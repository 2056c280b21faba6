"""Train the learned traversability head: `python -m training.traversability`."""

from training.traversability.train import main

main(prog_name="python -m training.traversability")

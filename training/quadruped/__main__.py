"""Train a policy: `python -m training.quadruped`."""

from training.quadruped.train import main

main(prog_name="python -m training.quadruped")

"""Train the completion network: `python -m training.completion`."""

from training.completion.train import main

main(prog_name="python -m training.completion")

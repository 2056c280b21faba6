"""Entry point of the command `torchelev` and of `python -m torchelev`."""

import sys


def run() -> None:
    """Start the command line; without its packages, print how to install them."""
    try:
        if sys.argv[1:2] == ["ros2"]:  # needs no PyTorch, which the other commands import
            from torchelev.app.ros2_command import ros2_command

            return ros2_command(sys.argv[2:], prog_name="torchelev ros2")
        from torchelev.app.cli import main
    except ModuleNotFoundError as error:
        sys.exit(f"Error: {error}; install the command line's packages with: pip install 'torchelev[io]'")
    main()


if __name__ == "__main__":
    run()

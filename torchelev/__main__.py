"""Entry point of the command `torchelev` and of `python -m torchelev`."""

import sys


def run() -> None:
    """Start the command line; without its packages, print how to install them."""
    try:
        from torchelev.app.cli import main
    except ModuleNotFoundError as error:
        sys.exit(f"Error: {error}; install the command line's packages with: pip install 'torchelev[io]'")
    main()


if __name__ == "__main__":
    run()

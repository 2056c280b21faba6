"""The command line: `python -m torchelev`."""

import sys


def run() -> None:
    """Run the command line, or say which packages it lacks."""
    try:
        from torchelev.app.cli import main
    except ModuleNotFoundError as error:
        sys.exit(f"Error: {error}; install the command line's packages with: pip install 'torchelev[io]'")
    main(prog_name="python -m torchelev")


if __name__ == "__main__":
    run()

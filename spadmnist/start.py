"""The program's first lines: from here on it answers signals, before anything that takes time is imported."""

from . import interrupts

interrupts.install()


def main() -> None:
    """Run the command line and exit."""
    from .cli import main

    main()


if __name__ == "__main__":
    main()

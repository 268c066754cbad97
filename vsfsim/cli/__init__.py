"""The command line."""

import sys


def start() -> None:
    """Entry point of the `vsfsim` command, which ends in one line when Ctrl-C stops it, also while it is imported."""
    try:
        from vsfsim.cli.main import main

        main()
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        sys.exit(130)

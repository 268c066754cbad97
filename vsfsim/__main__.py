"""`python -m vsfsim` is the command `vsfsim`."""

from vsfsim.cli.main import main

if __name__ == "__main__":
    main()

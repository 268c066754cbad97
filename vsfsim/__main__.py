"""`python -m vsfsim` is the command `vsfsim`."""

from vsfsim.cli import start

if __name__ == "__main__":
    start()

"""`python -m ihbench`, where the command itself is not on the path."""

import sys

from ihbench.cli import main

if __name__ == "__main__":  # not in the processes that a run starts: they import this module again
    sys.exit(main())

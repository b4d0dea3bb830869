"""python -m potr_cl."""

import sys

from potr_cl.cli import main

if __name__ == "__main__":
    sys.exit(main())

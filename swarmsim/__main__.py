"""``python -m swarmsim``: the same as the ``swarmsim`` command."""

import sys

from swarmsim.cli import main

if __name__ == "__main__":
    sys.exit(main())

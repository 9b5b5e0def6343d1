"""``python -m neuma_lib`` is the command ``neuma``."""

import sys

from neuma_lib.cli import main

if __name__ == "__main__":
    sys.exit(main())

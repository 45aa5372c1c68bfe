"""`python -m wheretolook` is the command `wheretolook`, for a Python whose scripts are not on the path."""

import sys

from wheretolook.cli import main

if __name__ == "__main__":  # processes that are spawned import this again
    sys.exit(main())

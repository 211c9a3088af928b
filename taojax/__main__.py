"""Lets `python -m taojax` do what `taojax` does."""

import sys

from taojax.cli import main

sys.exit(main())

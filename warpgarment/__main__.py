"""`python -m warpgarment` is `warpgarment`."""

import sys

from .cli import main

sys.exit(main())

"""``python -m refield``."""

import sys

from refield.cli import main

sys.exit(main())

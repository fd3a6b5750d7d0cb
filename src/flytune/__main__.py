"""`python -m flytune` is `flytune`."""

import sys

from flytune.cli import main

sys.exit(main())

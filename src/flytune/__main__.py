"""`python -m flytune` is `flytune`."""

import sys

from flytune.cli.main import main

sys.exit(main())

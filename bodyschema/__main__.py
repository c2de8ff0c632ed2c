"""`python -m bodyschema` is `bodyschema`."""

import os
import sys

if not sys.flags.safe_path:  # `-m` puts the current folder first, whose `numpy` is a user's own
    sys.path[0] = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))

from bodyschema.cli.main import main

main()

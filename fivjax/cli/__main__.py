"""`python -m fivjax.cli` is `fivjax`."""

import sys

from .command_line import main

sys.exit(main())

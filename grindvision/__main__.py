"""``python -m grindvision`` is the ``grindvision`` command."""

import sys

from grindvision.cli import main

sys.exit(main())

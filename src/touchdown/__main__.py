"""``python -m touchdown`` is the command ``touchdown``."""

import sys

from touchdown.experiments.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

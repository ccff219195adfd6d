"""``python -m handfast``: the command ``handfast``."""

from __future__ import annotations

import sys

from handfast.deploy.start import process

if __name__ == "__main__":
    sys.exit(process())

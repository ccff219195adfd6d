"""``python -m plant --fleet FILE --robot ID``: the simulated body of one robot as a process."""

import sys

from plant.server import main
from plant.unicycle import from_fleet

if __name__ == "__main__":
    sys.exit(main(None, "python -m plant", from_fleet))

"""Counts in a tally as fast as it can, until it is killed: one group of two, then one by itself."""

from __future__ import annotations

import sys
from pathlib import Path

from rtcore.ledger import Ledger
from rtcore.tally import Tally

if __name__ == "__main__":
    ledger = Ledger("env_server", 1, Tally.create(Path(sys.argv[1])))
    print("ready", flush=True)
    while True:
        ledger.count_together("ticks", "produced")
        ledger.count("published")

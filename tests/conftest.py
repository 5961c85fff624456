"""What all tests share."""

from __future__ import annotations

import signal

from hypothesis import settings

# The same examples on every run, and no deadline: the machine may be busy, the code under test is not.
settings.register_profile("tenuto", derandomize=True, deadline=None)
settings.load_profile("tenuto")

# A suite started in the background, or under nohup, inherits ignored signals, and hands them on to the
# processes that it interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

"""What all tests share."""

from __future__ import annotations

from hypothesis import settings

# The same examples on every run, and no deadline: the machine may be busy, the code under test is not.
settings.register_profile("tenuto", derandomize=True, deadline=None)
settings.load_profile("tenuto")

"""Keeping freed memory for the next gradient step."""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # from malloc.h
_MMAP_BYTES = 32 << 20  # the highest that glibc takes as the size from which it maps an array apart
_TRIM_BYTES = 1 << 30


def keep_freed_memory() -> bool:
    """Stop glibc from handing freed arrays back to the system; say whether it agreed.

    A gradient step frees and allocates the same half megabytes over and over. Handed back each time,
    they come back as fresh pages that fault one by one: 472 faults an update and 101 updates per CPU
    second, against none and 116 (SAC, batch 256, 256 x 256, one thread). Call it once, at the start of
    the process. On another C library it does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((_M_MMAP_THRESHOLD, _MMAP_BYTES), (_M_TRIM_THRESHOLD, _TRIM_BYTES))
    agreed = [
        mallopt(option, value) == 1 for option, value in settings
    ]  # ask for both, whatever the first says
    return all(agreed)

"""The few system calls for real time that Python does not offer. Nothing else here loads the C library."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable

CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
PR_SET_PDEATHSIG = 1
PR_SET_TIMERSLACK = 29
PR_GET_TIMERSLACK = 30
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def _load(name: str, *argument_types: object) -> Callable[..., int] | None:
    """The C function, typed; None on a system without it. CDLL lets go of the GIL during a call."""
    function = getattr(ctypes.CDLL(None, use_errno=True), name, None)
    if function is None:
        return None
    function.argtypes = argument_types
    function.restype = ctypes.c_int
    loaded: Callable[..., int] = function
    return loaded


_clock_nanosleep = _load(
    "clock_nanosleep", ctypes.c_int, ctypes.c_int, ctypes.POINTER(_Timespec), ctypes.c_void_p
)
_prctl = _load("prctl", ctypes.c_int, *[ctypes.c_ulong] * 4)
_mlockall = _load("mlockall", ctypes.c_int)
_setns = _load("setns", ctypes.c_int, ctypes.c_int)


def sleep_until_ns(deadline_ns: int) -> None:
    """Sleep once towards a monotonic instant, without the GIL.

    Returns early when a signal arrives, so that Python gets to run its handler: call again.
    """
    if _clock_nanosleep is not None:
        deadline = _Timespec(*divmod(deadline_ns, 1_000_000_000))
        if _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, ctypes.byref(deadline), None) in (0, errno.EINTR):
            return
    time.sleep(max(0, deadline_ns - time.monotonic_ns()) / 1e9)


def prctl(option: int, value: int = 0) -> int:
    """Ask the kernel about, or tell it about, this thread.

    Raises:
        OSError: refused, or no such call on this system.
    """
    return _checked("prctl", _prctl, option, value, 0, 0, 0)


def mlockall(flags: int) -> None:
    """Keep this process's pages in memory.

    Raises:
        OSError: refused, or no such call on this system.
    """
    _checked("mlockall", _mlockall, flags)


def setns(namespace: int) -> None:
    """Move this thread into a namespace, given as a file descriptor.

    Raises:
        OSError: refused, or no such call on this system.
    """
    _checked("setns", _setns, namespace, 0)


def _checked(name: str, function: Callable[..., int] | None, *arguments: int) -> int:
    if function is None:
        raise OSError(errno.ENOSYS, f"{name} does not exist on this system")
    result = function(*arguments)
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{name}: {os.strerror(number)}")
    return result

"""What ends a command with a message in place of a traceback."""

import os
import signal
from types import FrameType


class Refused(Exception):
    """Something the user gave cannot be used; the message says what and why."""


class Stopped(BaseException):
    """The process was asked to stop, by Ctrl-C or from outside."""

    def __init__(self, number: int) -> None:
        self.status = 128 + number
        by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
        super().__init__(f"stopped{by}; the same command resumes what is finished")


_received: list[int] = []


def listen_for_signals() -> None:
    """Makes Ctrl-C, SIGTERM and SIGHUP raise `Stopped`."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _raise_stopped)


def stop_if_asked() -> None:
    """Raises `Stopped` if a signal came: what a callback of compiled code raises can get lost."""
    if _received:
        raise Stopped(_received[0])


def _raise_stopped(number: int, frame: FrameType | None) -> None:
    del frame
    _received.append(number)
    if len(_received) > 3:  # nothing that runs lets the exception through
        os._exit(128 + number)
    raise Stopped(number)

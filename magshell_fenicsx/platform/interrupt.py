"""Errors and interrupts (KeyboardInterrupt) while a library calls functions of this program.

A library may raise an error of its own in place of such an error, which is then its cause.
"""

INTERRUPTED = 130  # exit code of a program that an interrupt ends


def is_interrupt(error: BaseException) -> bool:
    """Return whether an error was caused by KeyboardInterrupt, directly or through other errors."""
    cause = error.__cause__
    return cause is not None and (isinstance(cause, KeyboardInterrupt) or is_interrupt(cause))


def first_cause(error: BaseException) -> BaseException:
    """Return the error that has caused an error, directly or through others; itself without one."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error

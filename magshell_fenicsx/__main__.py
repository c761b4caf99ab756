"""The program `magshell`: it imports the command line, and runs it.

The imports take about a second. An interrupt within a library's import could end as another error,
or be lost. So it ends the process at once there, as nothing is to be finished yet.
"""

import gc
import os
import signal

from magshell_fenicsx.platform.interrupt import INTERRUPTED


def main() -> None:
    """Run the program, or end it without a word if it is interrupted while it is imported."""
    handler = signal.getsignal(signal.SIGINT)
    is_default = handler is signal.default_int_handler  # a job in the background ignores interrupts
    if is_default:
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    gc.disable()  # what is imported stays
    from magshell_fenicsx.cli import main as run_command_line

    gc.freeze()
    gc.enable()
    if is_default:
        signal.signal(signal.SIGINT, handler)
    run_command_line()


if __name__ == "__main__":
    main()

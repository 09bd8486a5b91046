"""`python -m sceneslam`; see `sceneslam.cli`."""

import os
import signal

# Set before NumPy loads BLAS: its sums depend on the number of threads, so runs would depend on the
# number of cores. Modules' processes inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Ctrl-C during loading ends the program without a traceback, unless it is ignored.
_handler = signal.getsignal(signal.SIGINT)
if _handler is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sceneslam.streams import secure_streams  # noqa: E402

secure_streams()

from sceneslam import cli  # noqa: E402
from sceneslam.sweep.plugin import register  # noqa: E402

signal.signal(signal.SIGINT, _handler)

__all__ = ["main"]


def main() -> None:
    """Run `python -m sceneslam` and exit, with our launchers and sweepers for `-m`."""
    register()
    cli.main()


if __name__ == "__main__":
    main()

"""`python -m sceneslam`; see `sceneslam.cli`."""

import os
import signal

# Before NumPy loads it: with more threads, BLAS adds in another order, and a run depended on the
# number of cores. The processes of modules inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Ctrl-C while it loads ends it without a traceback; where it is ignored, it stays so.
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
    """Run `python -m sceneslam` and exit; `-m` knows our launchers and sweepers."""
    register()
    cli.main()


if __name__ == "__main__":
    main()

"""`python -m sceneslam`; see `sceneslam.cli`."""

import os
import signal

# Set before NumPy loads BLAS: its sums depend on the number of threads, so runs would depend on the
# number of cores. Modules' processes inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _stop(number: int, frame: object) -> None:
    """End the program on Ctrl-C; an experiment's processes, which load this too, are silent."""
    if __name__ != "__mp_main__":
        os.write(2, b"error: stopped before the first observation\n")
    os._exit(2)


_handler = signal.getsignal(signal.SIGINT)
_loading = _stop if _handler is signal.default_int_handler else _handler  # it may be ignored
signal.signal(signal.SIGINT, _loading)

from sceneslam.streams import secure_streams  # noqa: E402

secure_streams()

from sceneslam import cli  # noqa: E402
from sceneslam.sweep.plugin import register  # noqa: E402

signal.signal(signal.SIGINT, _handler)

__all__ = ["main"]


def main() -> None:
    """Run `python -m sceneslam` and exit, with our launchers and sweepers for `-m`."""
    signal.signal(signal.SIGINT, _loading)
    register()
    signal.signal(signal.SIGINT, _handler)
    cli.main()


if __name__ == "__main__":
    main()

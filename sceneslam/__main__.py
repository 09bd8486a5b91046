"""`python -m sceneslam`; see `sceneslam.cli`."""

import os

# Before NumPy loads it: with more threads, BLAS adds in another order, and a run depended on the
# number of cores. The processes of modules inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from sceneslam.cli import main

__all__ = ["main"]

if __name__ == "__main__":
    main()

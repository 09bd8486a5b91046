"""`python -m sceneslam`."""

from sceneslam.cli import main

main()

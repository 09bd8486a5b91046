"""`python -m sceneslam.supervision LINE LIFELINE`: a module's process, on inherited descriptors."""

import sys

from sceneslam.supervision.worker import main

if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
